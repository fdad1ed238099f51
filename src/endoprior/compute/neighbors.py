"""Exact nearest neighbors of every point of a cloud among the others, on the CPU."""

from __future__ import annotations

import numpy as np
from numba import get_num_threads
from numpy.typing import NDArray
from scipy.spatial import KDTree

MAX_COORDINATE = 1e150
"""mm; squares of larger ones overflow."""


def nearest(points: NDArray, k: int) -> tuple[NDArray[np.intp], NDArray[np.float64]]:
    """The `k` nearest other points of each point, nearest first, equally near ones by index.

    Args:
        points: (P, 3) float32 or float64, magnitudes up to `MAX_COORDINATE`; 0 < k < P.
    Returns:
        (P, k) indices and (P, k) distances, computed in float64.
    """
    places = np.asarray(points, np.float64)
    num, tree = len(places), KDTree(places)
    indices, distances = np.empty((num, k), np.intp), np.empty((num, k))
    rows, asked = np.arange(num), min(k + 2, num)
    while len(rows):
        far, found = map(np.asarray, tree.query(places[rows], asked, workers=get_num_threads()))
        if not (far[:, 1:] > far[:, :-1]).all() or asked == num:  # the tree returns equally near ones in any order
            far[found == rows[:, None]] = np.inf  # a point itself comes last
            order = np.lexsort((found, far))
            far, found = np.take_along_axis(far, order, 1), np.take_along_axis(found, order, 1)
        else:
            far, found = far[:, 1:], found[:, 1:]
        # Where the last of the asked is as near as the last kept, others may be too, and the point itself be missing.
        known = (far[:, k - 1] < far[:, asked - 2]) | (asked == num)
        indices[rows[known]], distances[rows[known]] = found[known, :k], far[known, :k]
        rows, asked = rows[~known], min(2 * asked, num)
    return indices, distances
