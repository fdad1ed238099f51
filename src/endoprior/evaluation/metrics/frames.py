"""From one value per frame (or pair of frames) to one score of a sequence."""

from __future__ import annotations

from collections.abc import Iterable

import numpy as np


def mean_over_frames(values: Iterable[float]) -> float:
    """Mean of the finite values.

    NaN marks a frame on which the score is undefined (no tissue, no depth, no tool). Infinity is the PSNR of two equal
    images; it is ignored too, because one such frame would hide all others.

    Args:
        values: (T,) one value per frame or pair, any unit.
    Returns:
        The mean in the same unit; NaN when no value is finite.
    """
    array = np.asarray(list(values), dtype=np.float64)
    finite = array[np.isfinite(array)]
    return float(finite.mean()) if finite.size else float("nan")
