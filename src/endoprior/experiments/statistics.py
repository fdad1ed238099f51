"""Means, spreads, paired differences with a bootstrap interval, and verdicts on claims.

`K` paired observations: the same sequence, budget and seed by two methods.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Literal

import numpy as np
from numpy.typing import ArrayLike

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
class Difference:
    """Paired differences, positive where the first method is better; absolute or relative as `Score.compare` says."""

    mean: float
    low: float
    """Lower end of the 95 % bootstrap interval of the mean; NaN for fewer than two pairs."""
    high: float
    count: int


def summary(values: ArrayLike) -> Summary:
    """Mean and standard deviation of the finite values."""
    finite = [v for v in np.asarray(values, float).ravel() if math.isfinite(v)]
    mean = float(np.mean(finite)) if finite else math.nan
    return Summary(mean, float(np.std(finite, ddof=1)) if len(finite) > 1 else math.nan, len(finite))


def gains(score: str, ours: ArrayLike, theirs: ArrayLike) -> np.ndarray:
    """(K,) differences between ours and theirs, positive where ours is better; relative ones are shares of |theirs|.

    There is no share of nothing: NaN where theirs is 0 and ours is not.
    """
    ours, theirs, about = np.asarray(ours, float), np.asarray(theirs, float), all_scores()[score]
    change = ours - theirs
    if about.compare == "relative":
        share = change / np.maximum(np.abs(theirs), NOTHING)
        change = np.where((np.abs(theirs) > NOTHING) | (np.abs(change) <= NOTHING), share, np.nan)
    return change if about.higher_is_better else -change


def difference(values: ArrayLike, seed: int = 0) -> Difference:
    """Mean of K paired differences, with the percentile bootstrap interval over pairs."""
    values = np.asarray(values, float)
    values = values[np.isfinite(values)]
    if len(values) < 2:
        return Difference(float(values.mean()) if len(values) else math.nan, math.nan, math.nan, len(values))
    resampled = np.random.default_rng(seed).integers(len(values), size=(RESAMPLES, len(values)))
    tail = 50 * (1 - CONFIDENCE)
    low, high = np.percentile(values[resampled].mean(1), (tail, 100 - tail))
    return Difference(float(values.mean()), float(low), float(high), len(values))


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
