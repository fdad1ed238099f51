"""An order of points along a curve that fills space: points that follow each other lie near each other.

Gaussians are kept in this order because what belongs to neighbors (cells of a plane, tiles of a picture) then lies in
the cache when it is needed again. The order changes no result but for the rounding of sums.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

_FAR = 1e30
_BITS = 16
"""Per axis: far finer than the finest plane even if a few stray points blow up the box."""


def morton_order(points: NDArray) -> NDArray[np.intp]:
    """Indices that sort points along the Z-curve of their box.

    Args:
        points: (N, 3), any unit; infinity counts as very far, NaN as 0.
    Returns:
        (N,) permutation; points in the same cell of the curve keep their order.
    """
    finite = np.nan_to_num(np.asarray(points, np.float64), posinf=_FAR, neginf=-_FAR)
    if len(finite) == 0:
        return np.zeros(0, np.intp)
    low, high = finite.min(0), finite.max(0)
    cells = 2**_BITS
    scaled = (finite - low) / np.maximum(high - low, np.finfo(np.float64).tiny) * cells
    x, y, z = _spread(np.minimum(scaled.astype(np.int64), cells - 1)).T
    return np.argsort(x | y << 1 | z << 2, kind="stable")


def _spread(numbers: NDArray[np.int64]) -> NDArray[np.int64]:
    """Bit k of each number, moved to bit 3 k."""
    return sum((numbers >> k & 1) << 3 * k for k in range(_BITS))
