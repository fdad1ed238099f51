"""Means, spreads, paired differences with a bootstrap interval, and verdicts on claims.

`K` pairs: the same sequence, budget, seed and fold by two methods; `F` frames of a pair; `R` resamples.

The interval resamples in two levels: pairs, and within each the frames it is the mean of. Pairs that show the same
frames, those of other seeds, get the same draw of frames: a hard frame is hard for every seed, so that more seeds do
not make up for few frames (Owen 2007, The pigeonhole bootstrap, https://doi.org/10.1214/07-AOAS122).
"""

from __future__ import annotations

import math
from collections.abc import Hashable, Sequence
from dataclasses import dataclass
from functools import lru_cache
from typing import Literal

import numpy as np
from numpy.typing import ArrayLike, NDArray

from ..evaluation.registry import all_scores

Verdict = Literal["holds", "does not hold", "cannot be told"]

CONFIDENCE = 0.95
RESAMPLES = 10_000
NOTHING = 1e-12
"""Values up to this size count as 0 where a share is taken of them."""
MIN_PAIRS = 3
"""Fewer pairs give no verdict: the bootstrap interval of two pairs is the two values themselves."""


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

    ours: NDArray[np.float64]
    """(F,) values of single frames, whose mean is the score; or (1,) the score, where there are none."""
    theirs: NDArray[np.float64]
    """(F,) of the same frames."""
    frames: Hashable = None
    """Which frames: pairs with equal ones show the same F frames."""


@dataclass(frozen=True)
class Difference:
    """Paired differences, positive where the first method is better; absolute or relative as `Score.compare` says."""

    mean: float
    low: float
    """Lower end of the 95 % bootstrap interval of the mean; NaN for fewer than two pairs."""
    high: float
    count: int
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


def difference(score: str, pairs: Sequence[Pair], seed: int = 0) -> Difference:
    """Mean of the `gains` of pairs in a score, with the percentile bootstrap interval over pairs and their frames."""
    values = gains(score, [pair.ours.mean() for pair in pairs], [pair.theirs.mean() for pair in pairs])
    pairs, values = [pair for pair, value in zip(pairs, values, strict=True) if math.isfinite(value)], _finite(values)
    over_frames = any(len(pair.ours) > 1 for pair in pairs)
    if len(values) < 2:
        mean = float(values.mean()) if len(values) else math.nan
        return Difference(mean, math.nan, math.nan, len(values), over_frames)
    same = _same_frames(pairs)
    chosen, shares = _draws(seed, RESAMPLES, len(pairs), tuple(num for _, num in same))
    redrawn = values[chosen]
    if over_frames:
        redrawn = np.take_along_axis(gains(score, *_over_frames(pairs, [*same.values()], shares)), chosen, 1)
    means = _finite(redrawn.mean(1))  # frames can be drawn of which there is no share
    tail = 50 * (1 - CONFIDENCE)
    low, high = np.percentile(means, (tail, 100 - tail)) if len(means) else (math.nan, math.nan)
    return Difference(float(values.mean()), float(low), float(high), len(values), over_frames)


def _finite(values: NDArray) -> NDArray:
    """The finite ones of (N,) values."""
    return values[np.isfinite(values)]


def _same_frames(pairs: Sequence[Pair]) -> dict[tuple[Hashable, int], list[int]]:
    """The pairs that show the same frames, by these and their number."""
    same: dict[tuple[Hashable, int], list[int]] = {}
    for k, pair in enumerate(pairs):
        same.setdefault((pair.frames, len(pair.ours)), []).append(k)
    return same


@lru_cache(maxsize=4)  # the scores of a table have the same draws
def _draws(seed: int, resamples: int, num_pairs: int, nums: tuple[int, ...]) -> tuple[NDArray, list[NDArray]]:
    """(R, K) pairs drawn with replacement; and for each of `nums` frames, (R, F) the share of draws of each frame."""
    rng = np.random.default_rng(seed)
    chosen, shares = rng.integers(num_pairs, size=(resamples, num_pairs)), []
    for num in nums:
        drawn = rng.integers(num, size=(resamples, num)) + num * np.arange(resamples)[:, None]
        times = np.bincount(drawn.ravel(), minlength=num * resamples).reshape(resamples, num)
        shares.append(times / num)
    return chosen, shares


def _over_frames(
    pairs: Sequence[Pair], same: Sequence[list[int]], shares: Sequence[NDArray]
) -> tuple[NDArray, NDArray]:
    """(R, K) our and their means over the frames that are drawn, once for all pairs that show them."""
    means = np.empty((2, len(pairs), RESAMPLES))
    for members, share in zip(same, shares, strict=True):
        means[0, members] = np.array([pairs[k].ours for k in members]) @ share.T
        means[1, members] = np.array([pairs[k].theirs for k in members]) @ share.T
    return means[0].T, means[1].T


def verdict(measured: Difference, expect: str, by: float) -> Verdict:
    """Whether a claim holds; the interval alone decides.

    Args:
        expect: `better`: at least `by` better; `no worse`: at most `by` worse; `no effect`: within `by` either way.
        by: >= 0, in the unit of the difference.
    """
    if measured.count < MIN_PAIRS:
        return "cannot be told"
    if expect == "no effect":
        inside, outside = -by <= measured.low and measured.high <= by, measured.high < -by or measured.low > by
    elif expect == "no worse":
        inside, outside = measured.low >= -by, measured.high < -by
    else:  # a difference of 0 is not better
        inside, outside = measured.low >= by and measured.low > 0, measured.high < by or measured.high <= 0
    return "holds" if inside else "does not hold" if outside else "cannot be told"
