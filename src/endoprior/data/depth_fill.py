"""Which stored numbers of a depth file are measured: some programs write a large number where depth is missing."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

GAP = 1.5
"""A number is a filling if it is larger than all others by this factor ..."""
FEWEST = 8
"""... and occurs in at least so many pixels, which measured depth at such a distance does not."""
FARTHEST = 20.0
"""Depth beyond so many times the median of an image is an error of measurement."""
LEAST_PIXELS = 100
"""The median of fewer says nothing."""


def is_measured(stored: NDArray, *, relative: bool = False) -> NDArray[np.bool_]:
    """(H, W) True where a depth file holds a measurement.

    Missing is what is not finite, 0 or less; the largest number of a type of 16 bits or more; a number that occurs
    often and far above all others, such as 10000 or 1e6; and single numbers far above the median.

    Args:
        stored: (H, W) numbers of any type, in any unit.
        relative: the depth is only scaled, so that the largest number of a type may be the farthest pixel.
    """
    with np.errstate(invalid="ignore"):  # NaN compares as missing
        measured = np.isfinite(stored) & (stored > 0)
    if stored.dtype.kind in "iu" and stored.dtype.itemsize > 1 and not relative:
        measured &= stored != np.iinfo(stored.dtype).max
    while measured.any():
        values = stored[measured]
        largest = values.max()
        is_largest = values == largest
        count = int(is_largest.sum())
        if FEWEST <= count < values.size and largest > GAP * float(values[~is_largest].max()):
            measured &= stored != largest
            continue
        if values.size < LEAST_PIXELS or largest <= FARTHEST * float(values.min()):  # then none is beyond
            break
        return measured & (stored <= FARTHEST * float(np.median(values)))
    return measured
