"""Semi-global matching (Hirschmueller 2008): the surface that agrees with the costs and with its neighborhood.

Along each of eight directions r, the cost of plane d at pixel p is

    L_r(p, d) = C(p, d) + min(L_r(q, d), L_r(q, d - 1) + P1, L_r(q, d + 1) + P1, min_k L_r(q, k) + P2) - min_k L_r(q, k)

with q the pixel before p; the sum over all directions is the cost of the plane.
"""

from __future__ import annotations

import numpy as np
from numba import njit
from numpy.typing import NDArray

from ...compute.fastmath import REORDERED

DIRECTIONS = ((0, 1), (0, -1), (1, 0), (-1, 0), (1, 1), (-1, -1), (1, -1), (-1, 1))


def aggregated(costs: NDArray[np.float32], step: float, jump: float) -> NDArray[np.float32]:
    """(h, w, D) mean over the directions of the aggregated costs.

    Args:
        costs: (h, w, D) of each pixel and plane.
        step, jump: P1 and P2, the cost of a change by one plane, and of any other one.
    """
    total, path = np.zeros_like(costs), np.empty_like(costs)
    for dy, dx in DIRECTIONS:
        _add_direction(costs, dy, dx, np.float32(step), np.float32(jump), path, total)
    total /= np.float32(len(DIRECTIONS))
    return total


@njit(cache=True, nogil=True, fastmath=REORDERED)
def _add_direction(costs, dy, dx, step, jump, path, total):
    # path (h, w, D) is overwritten by L_r; total (h, w, D) gets it added.
    height, width, planes = costs.shape
    for row in range(height):
        y = row if dy >= 0 else height - 1 - row
        for column in range(width):
            x = column if dx >= 0 else width - 1 - column
            py, px = y - dy, x - dx
            here, cost = path[y, x], costs[y, x]
            if py < 0 or py >= height or px < 0 or px >= width:
                for d in range(planes):
                    here[d] = cost[d]
            else:
                before = path[py, px]
                least = before[0]
                for d in range(1, planes):
                    least = min(least, before[d])
                for d in range(planes):
                    best = min(before[d], least + jump)
                    if d > 0:
                        best = min(best, before[d - 1] + step)
                    if d < planes - 1:
                        best = min(best, before[d + 1] + step)
                    here[d] = cost[d] + best - least
            for d in range(planes):
                total[y, x, d] += here[d]
