"""An order of points along a curve that fills space: points that follow each other lie near each other.

Gaussians are kept in this order because memory that belongs to neighbors (cells of a plane, tiles of an image) is then
still in the cache when it is needed again. The order changes nothing but the rounding of sums.
"""

from __future__ import annotations

import numpy as np
from numba import njit, prange
from numpy.typing import NDArray

from .parallel_kernels import parallel_njit

_FAR = 1e30  # stands for infinity
_LONG_RUN = 256  # points in one cell of the curve that call for a finer one
_TINY = 1e-290  # smaller boxes get no curve: its scale would overflow


def morton_order(points: NDArray) -> NDArray[np.int64]:
    """`curve_order` of any points.

    Args:
        points: (N, 3), any unit; infinity counts as very far, NaN as 0.
    """
    finite = np.nan_to_num(np.asarray(points, np.float64), posinf=_FAR, neginf=-_FAR)
    return curve_order(np.clip(finite, -_FAR, _FAR)) if len(finite) else np.zeros(0, np.int64)


def curve_order(points: NDArray) -> NDArray[np.int64]:
    """Indices that sort finite points along a Morton curve through their box.

    A cell of the curve can hold very many points if a few others are far away: it gets a finer curve of its own.

    Args:
        points: (N, 3) float32 or float64, finite, N > 0.
    Returns:
        (N,) permutation; points in the same cell keep their order.
    """
    num = len(points)
    index_bits = max((num - 1).bit_length(), 1)
    keys = np.empty(num, np.int64)
    _curve_keys(points, index_bits, (63 - index_bits) // 3, keys)
    keys.sort()
    order, cells = keys & ((1 << index_bits) - 1), keys >> index_bits
    if num > _LONG_RUN and (cells[_LONG_RUN:] == cells[:-_LONG_RUN]).any():
        ends = np.r_[0, np.flatnonzero(np.diff(cells)) + 1, num]
        for i in np.flatnonzero(np.diff(ends) > _LONG_RUN):
            run = order[ends[i] : ends[i + 1]]
            cluster = points[run]
            if np.ptp(cluster.astype(np.float64), axis=0).max() > _TINY:
                run[:] = run[curve_order(cluster)]
    return order


@njit(cache=True, inline="always")
def _spread(v):
    # Bits of v, at most 21, moved to every third place.
    v = (v | (v << 32)) & 0x1F00000000FFFF
    v = (v | (v << 16)) & 0x1F0000FF0000FF
    v = (v | (v << 8)) & 0x100F00F00F00F00F
    v = (v | (v << 4)) & 0x10C30C30C30C30C3
    return (v | (v << 2)) & 0x1249249249249249


@parallel_njit(error_model="numpy")
def _curve_keys(points, index_bits, axis_bits, keys):
    # Writes cell << index_bits | index for each point; cells are cubes, 2^axis_bits along the longest side.
    low, high = np.empty(3), np.empty(3)
    for a in range(3):
        low[a] = high[a] = np.float64(points[0, a])
    for i in range(len(points)):
        for a in range(3):
            x = np.float64(points[i, a])
            low[a], high[a] = min(low[a], x), max(high[a], x)
    span = max(high[0] - low[0], high[1] - low[1], high[2] - low[2])
    cells = np.float64(1 << axis_bits)
    scale = cells / span if span > _TINY else 0.0
    for i in prange(len(points)):
        cell = 0
        for a in range(3):
            cell |= _spread(np.int64(min((np.float64(points[i, a]) - low[a]) * scale, cells - 1))) << a
        keys[i] = (cell << index_bits) | i
