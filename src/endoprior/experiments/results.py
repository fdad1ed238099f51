"""The scores of all finished cells: their means over seeds, paired differences, and claims about them."""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from ..evaluation.protocols.table import ProtocolName
from ..evaluation.registry import all_scores
from .matrix import Matrix, scores_of
from .spec import Cell, ClaimSpec, Spec
from .statistics import Difference, Summary, Verdict, difference, gains, summary, verdict


@dataclass(frozen=True)
class Results:
    """Scores by cell; cells without a result are left out."""

    spec: Spec
    scores: dict[Cell, dict[str, float]]
    relative: frozenset[str] = frozenset()
    """Sequences whose lengths are not in mm."""

    @staticmethod
    def of(matrix: Matrix, protocol: ProtocolName | None = None) -> Results:
        """Read the scores of all finished cells, in the order of the spec; those of another paper's `protocol`."""
        order = sorted(matrix.done, key=lambda c: (c.sequence, c.budget or 0, c.method, c.seed))
        stored = {cell: scores_of(matrix.done[cell]) for cell in order}
        own = {cell: about["protocols"][protocol] if protocol else about for cell, about in stored.items()}
        scores = {cell: about["scores"] for cell, about in own.items()}
        return Results(matrix.spec, scores, frozenset(matrix.relative))

    def value(self, cell: Cell, score: str) -> float:
        """A score; NaN where it was skipped."""
        return float(self.scores.get(cell, {}).get(score, math.nan))

    def summary(self, sequence: str, budget: int | None, method: str, score: str) -> Summary:
        """Mean and standard deviation over seeds; scores of masks, which are found once, have no deviation."""
        values = [self.value(Cell(sequence, method, budget, seed), score) for seed in self.spec.seeds]
        known = all_scores().get(score)
        return summary([*{*values}] if known and known.group == "masks" else values)

    def gains(
        self, score: str, method: str, than: str, *, sequence: str | None = None, budget: int | None = None
    ) -> NDArray:
        """(K,) paired `statistics.gains` over sequences, budgets and seeds, positive where `method` is better."""
        pairs = [
            (Cell(name, method, size, seed), Cell(name, than, size, seed))
            for name in ([sequence] if sequence else self.spec.sequences)
            for size in ((budget,) if budget else self.spec.budgets or (None,))
            for seed in self.spec.seeds
        ]
        return self._gains(score, pairs)

    def _gains(self, score: str, pairs: list[tuple[Cell, Cell]]) -> NDArray:
        ours, theirs = np.array([[self.value(cell, score) for cell in pair] for pair in pairs]).T
        return gains(score, ours, theirs)

    def difference(self, score: str, method: str, than: str, sequence: str | None = None) -> Difference:
        """Mean paired difference with its interval."""
        return difference(self.gains(score, method, than, sequence=sequence))

    def gain_of_found(self, score: str, method: str, sequence: str, own: str) -> Difference:
        """Mean paired difference of one method with found masks or poses to the same with the sequence's own.

        Args:
            sequence, own: names of the sequence with found parts, and with its own.
        """
        pairs = [
            (Cell(sequence, method, size, seed), Cell(own, method, size, seed))
            for size in self.spec.budgets or (None,)
            for seed in self.spec.seeds
        ]
        return difference(self._gains(score, pairs))

    def check(self, claim: ClaimSpec, sequence: str | None = None) -> tuple[Difference, Verdict]:
        """Whether a claim holds, on one sequence or on all."""
        measured = difference(self.gains(claim.score, claim.method, claim.than, sequence=sequence, budget=claim.budget))
        return measured, verdict(measured, claim.expect, claim.by)
