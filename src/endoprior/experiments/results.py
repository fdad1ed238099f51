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
        order = sorted(matrix.done, key=lambda c: (c.sequence, c.budget or 0, c.method, c.seed, c.fold))
        stored = {cell: scores_of(matrix.done[cell]) for cell in order}
        own = {cell: about["protocols"][protocol] if protocol else about for cell, about in stored.items()}
        scores = {cell: about["scores"] for cell, about in own.items()}
        return Results(matrix.spec, scores, frozenset(matrix.relative))

    def value(self, cell: Cell, score: str) -> float:
        """A score; NaN where it was skipped."""
        return float(self.scores.get(cell, {}).get(score, math.nan))

    def summary(self, sequence: str, budget: int | None, method: str, score: str) -> Summary:
        """Mean and standard deviation over seeds of the mean over folds.

        Scores of masks, which are found once, have no deviation.
        """
        values = [self._over_folds(sequence, budget, method, score, seed) for seed in self.spec.seeds]
        known = all_scores().get(score)
        return summary([*{*values}] if known and known.group == "masks" else values)

    def _over_folds(self, sequence: str, budget: int | None, method: str, score: str, seed: int) -> float:
        """Mean over the folds that have the score; NaN if a cell is missing, because folds are not equally hard."""
        folds = [Cell(sequence, method, budget, seed, fold) for fold in self.spec.folds(sequence, method)]
        complete = all(cell in self.scores for cell in folds)
        return summary([self.value(cell, score) for cell in folds]).mean if complete else math.nan

    def gains(
        self, score: str, method: str, than: str, *, sequence: str | None = None, budget: int | None = None
    ) -> NDArray:
        """(K,) paired `statistics.gains` over sequences, budgets, seeds, folds; positive where `method` is better."""
        names = [sequence] if sequence else self.spec.sequences
        return self._gains(score, [p for name in names for p in self._pairs((name, method), (name, than), budget)])

    def _pairs(
        self, ours: tuple[str, str], theirs: tuple[str, str], budget: int | None = None
    ) -> list[tuple[Cell, Cell]]:
        """Cells of equal budget, seed and fold of two (sequence, method)."""
        return [
            (Cell(*ours, size, seed, fold), Cell(*theirs, size, seed, fold))
            for size in ((budget,) if budget else self.spec.budgets or (None,))
            for seed in self.spec.seeds
            for fold in self.spec.folds(*ours)
            if fold in self.spec.folds(*theirs)
        ]

    def _gains(self, score: str, pairs: list[tuple[Cell, Cell]]) -> NDArray:
        ours, theirs = np.array([[self.value(cell, score) for cell in pair] for pair in pairs]).reshape(-1, 2).T
        return gains(score, ours, theirs)

    def difference(self, score: str, method: str, than: str, sequence: str | None = None) -> Difference:
        """Mean paired difference with its interval."""
        return difference(self.gains(score, method, than, sequence=sequence))

    def gain_of_found(self, score: str, method: str, sequence: str, own: str) -> Difference:
        """Mean paired difference of one method with found masks or poses to the same with the sequence's own.

        Args:
            sequence, own: names of the sequence with found parts, and with its own.
        """
        return difference(self._gains(score, self._pairs((sequence, method), (own, method))))

    def check(self, claim: ClaimSpec, sequence: str | None = None) -> tuple[Difference, Verdict]:
        """Whether a claim holds, on one sequence or on all."""
        measured = difference(self.gains(claim.score, claim.method, claim.than, sequence=sequence, budget=claim.budget))
        return measured, verdict(measured, claim.expect, claim.by)
