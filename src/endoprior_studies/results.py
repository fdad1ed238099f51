"""The scores of all finished cells: their means over seeds, paired differences, and claims about them."""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass, field

import numpy as np

from endoprior.evaluation.registry import all_scores

from .matrix import Matrix, frames_of, scores_of
from .spec import Cell, ClaimSpec, Spec
from .statistics import Difference, Pair, Summary, Verdict, difference, summary, verdict


@dataclass(frozen=True)
class Results:
    """Scores by cell; cells without a result are left out."""

    spec: Spec
    scores: dict[Cell, dict[str, float]]
    relative: frozenset[str] = frozenset()
    """Sequences whose lengths are not in mm."""
    frames: Mapping[Cell, dict[str, dict[int, float]]] = field(default_factory=dict)
    """Values of single frames, by score and frame; a cell may have none."""

    @staticmethod
    def of(matrix: Matrix, protocol: str | None = None) -> Results:
        """Read the scores of all finished cells, in the order of the spec; those of another paper's `protocol`."""
        order = sorted(matrix.done, key=lambda c: (c.sequence, c.budget or 0, c.method, c.seed, c.fold))
        stored = {cell: scores_of(matrix.done[cell]) for cell in order}
        own = {cell: about["protocols"][protocol] if protocol else about for cell, about in stored.items()}
        scores = {cell: about["scores"] for cell, about in own.items()}
        frames = {} if protocol else {cell: frames_of(matrix.done[cell]) for cell in order}
        return Results(matrix.spec, scores, frozenset(matrix.relative), frames)

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

    def pairs(
        self, score: str, method: str, than: str, *, sequence: str | None = None, budget: int | None = None
    ) -> list[Pair]:
        """The score by two methods, for all sequences, budgets, seeds and folds."""
        names = [sequence] if sequence else self.spec.sequences
        return [pair for name in names for pair in self._pairs(score, (name, method), (name, than), budget)]

    def _pairs(
        self, score: str, ours: tuple[str, str], theirs: tuple[str, str], budget: int | None = None
    ) -> list[Pair]:
        """Cells of equal budget, seed and fold of two (sequence, method)."""
        return [
            self._pair(score, Cell(*ours, size, seed, fold), Cell(*theirs, size, seed, fold))
            for size in ((budget,) if budget else self.spec.budgets or (None,))
            for seed in self.spec.seeds
            for fold in self.spec.folds(*ours)
            if fold in self.spec.folds(*theirs)
        ]

    def _pair(self, score: str, ours: Cell, theirs: Cell) -> Pair:
        """Of frames where both have values of the same ones; else of the scores."""
        a, b = self._of_frames(ours, score), self._of_frames(theirs, score)
        if not a or a.keys() != b.keys():
            a, b = {-1 - ours.fold: self.value(ours, score)}, {-1 - ours.fold: self.value(theirs, score)}
        frames = tuple(sorted(a))
        ours_values, theirs_values = (np.array([of[i] for i in frames], float) for of in (a, b))
        return Pair((ours.sequence, ours.budget), ours.seed, ours_values, theirs_values, frames)

    def _of_frames(self, cell: Cell, score: str) -> dict[int, float]:
        """Values of single frames; none where the score is not their mean, as a plugin's need not be."""
        found = self.frames.get(cell, {}).get(score, {})
        is_mean = found and math.isclose(np.mean([*found.values()]), self.value(cell, score), rel_tol=1e-6)
        return found if is_mean else {}

    def difference(self, score: str, method: str, than: str, sequence: str | None = None) -> Difference:
        """Mean paired difference with its interval."""
        return difference(score, self.pairs(score, method, than, sequence=sequence))

    def gain_of_found(self, score: str, method: str, sequence: str, own: str) -> Difference:
        """Mean paired difference of one method with found masks or poses to the same with the sequence's own.

        Args:
            sequence, own: names of the sequence with found parts, and with its own.
        """
        return difference(score, self._pairs(score, (sequence, method), (own, method)))

    def check(self, claim: ClaimSpec) -> dict[str, tuple[Difference, Verdict]]:
        """What is measured of a claim, and whether it holds, on each sequence that has the score."""
        found = {}
        for name in self.spec.sequences:
            pairs = self.pairs(claim.score, claim.method, claim.than, sequence=name, budget=claim.budget)
            measured = difference(claim.score, pairs)
            if measured.count:
                found[name] = measured, verdict(measured, claim.expect, claim.by)
        return found

    def together(self, claim: ClaimSpec) -> Difference:
        """What is measured of a claim on all sequences together."""
        return difference(claim.score, self.pairs(claim.score, claim.method, claim.than, budget=claim.budget))
