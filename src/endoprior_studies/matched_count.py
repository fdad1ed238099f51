"""A method whose growth threshold is searched until it ends with as many Gaussians as wanted.

Methods that differ in how many Gaussians they end with differ in quality for that reason alone. The count falls as the
threshold of growth rises, about as a power of it: the search is a bracketed secant in the logarithms of both.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field

from endoprior.runs.log import Growth

from .spec import Cell, MatchSpec, Spec

WITHIN = 0.03
"""Share of the wanted count by which the found one may differ."""
MAX_PROBES = 8
FIRST_SLOPE = 0.7
"""Power with which the count is taken to fall before two trainings say it."""
MIN_SLOPE = 0.1
MAX_STEP = 8.0
"""Factor between two thresholds while all tried ones lie on one side."""
INSIDE = 0.1
"""Share of the bracket, in logarithms, that the next threshold keeps away from its ends."""

Place = tuple[str, str, int | None]
"""Sequence, method and budget: what has a threshold of its own."""


@dataclass
class Search:
    """What was tried for one method on one sequence."""

    start: float
    """The threshold of the method's own config."""
    tried: list[tuple[float, Growth]] = field(default_factory=list)
    target: float = math.nan
    """Wanted number of Gaussians, known once it can be."""
    failure: str = ""
    """Why there is no result."""

    @property
    def best(self) -> tuple[float, Growth]:
        """The threshold that comes nearest, and what it gave."""
        return min(self.tried, key=lambda entry: abs(math.log(entry[1].last / self.target)))

    @property
    def matched(self) -> bool:
        """Whether the count is as near as wanted."""
        return abs(self.best[1].last / self.target - 1) <= WITHIN


def next_threshold(search: Search) -> float | None:
    """The threshold to train with next; None if the search is over, with or without success."""
    if not search.tried:
        return search.start
    if search.matched or len(search.tried) >= MAX_PROBES:
        return None
    points = [(math.log(value), math.log(growth.last / search.target)) for value, growth in search.tried]
    above, below = [p for p in points if p[1] > 0], [p for p in points if p[1] <= 0]
    if above and below:
        (low, excess), (high, lack) = max(above), min(below)
        if low >= high:  # counts that do not fall with the threshold: noise decides, so stop
            return None
        share = excess / (excess - lack)
        return math.exp(low + min(max(share, INSIDE), 1 - INSIDE) * (high - low))
    value, excess = max(above) if above else min(below)
    slope = FIRST_SLOPE
    if len(points) > 1:
        (one, first), (other, second) = points[-2:]
        slope = max((first - second) / (other - one), MIN_SLOPE)
    step = min(max(excess / slope, -math.log(MAX_STEP)), math.log(MAX_STEP))
    return math.exp(value + step)


def search_thresholds(
    spec: Spec, counts: Callable[[Place], float], train: Callable[[dict[Cell, float]], dict[Cell, Growth | str]]
) -> dict[Place, Search]:
    """Search for every method with a `MatchSpec`, in rounds: those of one round train side by side.

    Args:
        counts: mean number of Gaussians of a finished method without a search; NaN if there is none.
        train: trains cells, of the first seed and fold, with the thresholds given; their growth, or why there is none.
    Returns:
        A search per place; those with `value_of` share that of another method.
    """
    found: dict[Place, Search] = {}
    matches = matches_of(spec)
    probes = {place: Cell(*place, spec.seeds[0], spec.sequences[place[0]].folds[0]) for place in matches}
    for place, match in matches.items():
        sequence, method, budget = place
        if match.value_of:
            continue
        start = spec.config(method, sequence, budget, spec.seeds[0]).density.grow_threshold
        found[place] = Search(start)
        if match.count_of:
            target = found[place].target = counts((sequence, match.count_of, budget))
            found[place].failure = "" if target > 0 else f"{match.count_of} has no result to match"
    while wanted := {place: value for place, search in found.items() if (value := _next(search)) is not None}:
        results = train({probes[place]: value for place, value in wanted.items()})
        for place, value in wanted.items():
            result, search = results[probes[place]], found[place]
            if isinstance(result, str):
                search.failure = result
                continue
            search.tried.append((value, result))
            if growth := matches[place].growth:
                search.target = growth * result.first
    for place, match in matches.items():
        if match.value_of:
            found[place] = found[place[0], match.value_of, place[2]]
    return found


def _next(search: Search) -> float | None:
    return None if search.failure else next_threshold(search)


def matches_of(spec: Spec) -> dict[Place, MatchSpec]:
    """How each threshold is searched."""
    budgets: Sequence[int | None] = spec.budgets or (None,)
    methods = {method: about.match for method, about in spec.methods.items() if about.match}
    return {(s, m, b): match for s in spec.sequences for m, match in methods.items() for b in budgets}
