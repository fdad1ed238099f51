"""How much nearer than their surroundings the tools of a clip are, learned from the tools that color found.

Stereo depth is often wrong on shiny metal, so relief only changes the odds of color by a limited factor.
`h, w` image size.
"""

from __future__ import annotations

from collections.abc import Iterable

import cv2
import numpy as np
from numpy.typing import NDArray
from scipy.ndimage import gaussian_filter1d

MOST_ODDS = 4.0
"""Depth changes the odds at most by this factor."""
SHRINK = 4
"""Surroundings are smooth: their depth is averaged at a quarter of the size."""
EDGES = np.linspace(-0.6, 0.6, 41)
"""Bin edges of log(surroundings / depth); values beyond a factor of 1.8 share the outer bins."""


def relief_cells(depth: NDArray[np.float32], tissue: NDArray[np.bool_]) -> NDArray[np.intp]:
    """(h, w) cell of log(surroundings / depth), positive nearer than the `tissue` around; the last cell: missing."""
    size = (max(1, depth.shape[1] // SHRINK), max(1, depth.shape[0] // SHRINK))
    known = ((depth > 0) & tissue).astype(np.float32)
    total, count = (cv2.resize(x, size, interpolation=cv2.INTER_AREA) for x in (known * depth, known))
    spread = max(size) / 8  # an eighth of the image: wider than a tool, narrower than the scene's own slope
    total, count = (cv2.GaussianBlur(x, (0, 0), spread) for x in (total, count))
    level = cv2.resize(total / np.maximum(count, 1e-6), depth.shape[::-1], interpolation=cv2.INTER_LINEAR)
    measured = (depth > 0) & (level > 0)
    relief = np.log(np.where(measured, level, 1) / np.where(measured, depth, 1))
    return np.where(measured, np.digitize(relief, EDGES), len(EDGES) + 1)


def relief_log_odds(
    frames: Iterable[tuple[NDArray[np.float32], NDArray[np.bool_], NDArray[np.bool_]]],
) -> NDArray[np.float32] | None:
    """(cells,) log of the likelihood ratio of a relief on a tool to one beside it; None without tools or depth.

    Args:
        frames: depth (h, w), 0 where missing; tools (h, w); view (h, w).
    """
    on, off = np.zeros((2, len(EDGES) + 2))
    for depth, tools, view in frames:
        cell = relief_cells(depth, view & ~tools)
        on += np.bincount(cell[tools], minlength=on.size)
        off += np.bincount(cell[view & ~tools], minlength=on.size)
    if not on[:-1].any() or not off[:-1].any():
        return None
    on_share, off_share = (gaussian_filter1d(count[:-1], 1.5) / count.sum() + 0.002 for count in (on, off))
    limit = np.log(MOST_ODDS)
    return np.append(np.clip(np.log(on_share / off_share), -limit, limit), 0.0).astype(np.float32)
