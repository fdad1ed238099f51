"""Means, spreads, paired differences with a bootstrap interval, and what they say about a claim.

`K` paired observations: the same sequence, budget and seed by two methods.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Literal

import numpy as np
from numpy.typing import ArrayLike

Verdict = Literal["holds", "does not hold", "cannot be told"]

IN_DB = frozenset({"psnr", "psnr_tissue", "psnr_behind_tool", "strict_psnr"})
RATES = frozenset({"ssim", "strict_ssim", "track_fold_rate", "track_tear_rate"})
RARE = frozenset({"num_low_prior", "num_low_opacity", "num_large_scale"})
"""Counts that may well be 0."""
ABSOLUTE = IN_DB | RATES | RARE
"""Scores whose differences mean something as they are; of all others they are relative."""
HIGHER_IS_BETTER = IN_DB | {"ssim", "strict_ssim", "fps", "fps_cached", "iterations_per_second"}
"""Every other score is an error, a count or a time."""

CONFIDENCE = 0.95
RESAMPLES = 10_000
MIN_PAIRS = 3
"""With fewer pairs nothing is said: the interval of two is the two."""


@dataclass(frozen=True)
class Summary:
    """One score of one method over seeds."""

    mean: float
    std: float
    """Standard deviation over seeds with n - 1; NaN for one."""
    count: int


@dataclass(frozen=True)
class Difference:
    """Paired differences, positive where the first method is better: in units of `ABSOLUTE` scores, else relative."""

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
    """(K,) differences ours - theirs, relative to |theirs| unless `ABSOLUTE`, turned so that positive is better."""
    ours, theirs = np.asarray(ours, float), np.asarray(theirs, float)
    change = ours - theirs
    if score not in ABSOLUTE:
        change = change / np.maximum(np.abs(theirs), 1e-12)
    return change if score in HIGHER_IS_BETTER else -change


def difference(values: ArrayLike, seed: int = 0) -> Difference:
    """Mean of K paired differences, with the percentile bootstrap interval over pairs."""
    values = np.asarray(values, float)
    values = values[np.isfinite(values)]
    if len(values) < 2:
        return Difference(float(values.mean()) if len(values) else math.nan, math.nan, math.nan, len(values))
    drawn = np.random.default_rng(seed).integers(len(values), size=(RESAMPLES, len(values)))
    tail = 50 * (1 - CONFIDENCE)
    low, high = np.percentile(values[drawn].mean(1), (tail, 100 - tail))
    return Difference(float(values.mean()), float(low), float(high), len(values))


def verdict(found: Difference, expect: str, by: float) -> Verdict:
    """Whether a claim holds, by the interval alone.

    Args:
        expect: `better`: at least `by` better; `no worse`: at most `by` worse; `no effect`: within `by` either way.
        by: >= 0, in the unit of the difference.
    """
    if found.count < MIN_PAIRS:
        return "cannot be told"
    if expect == "no effect":
        inside, outside = -by <= found.low and found.high <= by, found.high < -by or found.low > by
    elif expect == "no worse":
        inside, outside = found.low >= -by, found.high < -by
    else:  # better by nothing is not better
        inside, outside = found.low >= by and found.low > 0, found.high < by or found.high <= 0
    return "holds" if inside else "does not hold" if outside else "cannot be told"
