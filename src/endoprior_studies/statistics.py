"""Means, spreads, paired differences with an interval, and verdicts on claims.

A pair is one score of two methods on the same place (sequence and budget), seed and fold; `F` frames of a pair.

Seeds and frames are crossed: a seed trains once for each fold, and a frame that is hard is hard for every seed. So more
folds do not make up for few seeds, nor more seeds for few frames. With the means of seeds m (S of them) and of frames u
(U, each over all seeds), the variance of the mean difference is taken as

    var(m) / S + var(u) / U

which counts what belongs to both twice, and its degrees of freedom are those of Satterthwaite (1946,
https://doi.org/10.2307/3002019). A score without values of frames has folds in their place. Places are those that the
spec names, not drawn from others: their means are averaged, and their variances added.
"""

from __future__ import annotations

import math
from collections.abc import Hashable, Sequence
from dataclasses import dataclass
from typing import Literal

import numpy as np
from numpy.typing import ArrayLike, NDArray
from scipy.special import stdtrit

from endoprior.evaluation.registry import all_scores

Verdict = Literal["holds", "does not hold", "cannot be told"]

CONFIDENCE = 0.95
NOTHING = 1e-12
"""Values up to this size count as 0 where a share is taken of them."""


@dataclass(frozen=True)
class Summary:
    """One score of one method over seeds."""

    mean: float
    std: float
    """Standard deviation over seeds with n - 1; NaN for one."""
    count: int


@dataclass(frozen=True)
class Pair:
    """One score by two methods."""

    place: Hashable
    """What the spec fixes: sequence and budget."""
    seed: int
    ours: NDArray[np.float64]
    """(F,) values of single frames, whose mean is the score; or (1,) the score, where there are none."""
    theirs: NDArray[np.float64]
    """(F,) of the same frames."""
    frames: tuple[Hashable, ...]
    """(F,) which frame each value is of, the same for other seeds; the fold, where there are none."""


@dataclass(frozen=True)
class Difference:
    """Paired differences, positive where the first method is better; absolute or relative as `Score.compare` says."""

    mean: float
    low: float
    """Lower end of the 95 % interval of the mean; NaN where a place has fewer than two seeds."""
    high: float
    count: int
    """Pairs that have the score."""
    over_frames: bool = False
    """Whether the interval is over frames too."""


def summary(values: ArrayLike) -> Summary:
    """Mean and standard deviation of the finite values."""
    finite = [v for v in np.asarray(values, float).ravel() if math.isfinite(v)]
    mean = float(np.mean(finite)) if finite else math.nan
    return Summary(mean, float(np.std(finite, ddof=1)) if len(finite) > 1 else math.nan, len(finite))


def gains(score: str, ours: ArrayLike, theirs: ArrayLike) -> np.ndarray:
    """(..., K) differences of ours and theirs, positive where ours is better; relative ones are shares of |theirs|.

    There is no share of nothing: NaN where theirs is 0 and ours is not.
    """
    ours, theirs, about = np.asarray(ours, float), np.asarray(theirs, float), all_scores()[score]
    change = ours - theirs
    if about.compare == "relative":
        share = change / np.maximum(np.abs(theirs), NOTHING)
        change = np.where((np.abs(theirs) > NOTHING) | (np.abs(change) <= NOTHING), share, np.nan)
    return change if about.higher_is_better else -change


def difference(score: str, pairs: Sequence[Pair]) -> Difference:
    """Mean of the `gains` of pairs in a score, places counting alike, with its interval over seeds and frames."""
    places: dict[Hashable, list[Pair]] = {}
    for pair in pairs:
        if math.isfinite(_gain(score, pair)):
            places.setdefault(pair.place, []).append(pair)
    if not places:
        return Difference(math.nan, math.nan, math.nan, 0)
    mean = float(np.mean([np.mean([_gain(score, pair) for pair in members]) for members in places.values()]))
    half = _half_width([part for members in places.values() for part in _variances(score, members)], len(places))
    members = [pair for of in places.values() for pair in of]
    over_frames = any(len(pair.ours) > 1 for pair in members)
    return Difference(mean, mean - half, mean + half, len(members), over_frames)


def _gain(score: str, pair: Pair) -> float:
    return float(gains(score, pair.ours.mean(), pair.theirs.mean()))


def _variances(score: str, pairs: Sequence[Pair]) -> list[tuple[float, int]]:
    """Variance of the mean gain of one place by seeds, and by frames; each with its degrees of freedom."""
    of_seed: dict[Hashable, list[float]] = {}
    of_frame: dict[Hashable, list[float]] = {}
    for pair in pairs:
        values = _gains_of_frames(score, pair)
        of_seed.setdefault(pair.seed, []).append(float(values.mean()))
        for frame, value in zip(pair.frames, values, strict=True):
            of_frame.setdefault(frame, []).append(value)
    return [_variance(of_seed), *([_variance(of_frame)] if len(of_frame) > 1 else [])]


def _variance(groups: dict[Hashable, list[float]]) -> tuple[float, int]:
    """Variance of the mean of the means of groups, and its degrees of freedom; NaN for one group."""
    means, count = [np.mean(group) for group in groups.values()], len(groups)
    return (float(np.var(means, ddof=1)) / count if count > 1 else math.nan), count - 1


def _gains_of_frames(score: str, pair: Pair) -> NDArray[np.float64]:
    """(F,) values whose mean is the gain of a pair: those of its frames; of a share, to first order in both means."""
    about, mean = all_scores()[score], float(pair.theirs.mean())
    if about.compare == "absolute":
        return gains(score, pair.ours, pair.theirs)
    if abs(mean) <= NOTHING:
        return np.zeros_like(pair.ours)
    first_order = (pair.ours - pair.ours.mean() / mean * pair.theirs) / abs(mean)
    return _gain(score, pair) + (first_order if about.higher_is_better else -first_order)


def _half_width(parts: Sequence[tuple[float, int]], num_places: int) -> float:
    """Half of the interval of a mean over places, from variances with their degrees of freedom; NaN if one is."""
    total = sum(of for of, _ in parts)
    if not total > 0:
        return total
    degrees = total**2 / sum(of**2 / free for of, free in parts)
    return float(stdtrit(degrees, (1 + CONFIDENCE) / 2)) * math.sqrt(total) / num_places


def verdict(measured: Difference, expect: str, by: float) -> Verdict:
    """Whether a claim holds; the interval alone decides.

    Args:
        expect: `better`: at least `by` better; `no worse`: at most `by` worse; `no effect`: within `by` either way.
        by: >= 0, in the unit of the difference.
    """
    if not math.isfinite(measured.low):
        return "cannot be told"
    if expect == "no effect":
        inside, outside = -by <= measured.low and measured.high <= by, measured.high < -by or measured.low > by
    elif expect == "no worse":
        inside, outside = measured.low >= -by, measured.high < -by
    else:  # a difference of 0 is not better
        inside, outside = measured.low >= by and measured.low > 0, measured.high < by or measured.high <= 0
    return "holds" if inside else "does not hold" if outside else "cannot be told"
