"""Which points of the tissue the endoscope sees, in a frame and ever."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from .config import PhantomConfig


def visible_points(
    points: NDArray, z: NDArray[np.float32], tool: NDArray[np.bool_], cfg: PhantomConfig
) -> NDArray[np.bool_]:
    """(...,) True where `points` (..., 3) are in the image and not occluded by tissue `z` (H, W) or `tool`."""
    ahead = points[..., 2] > 0
    depth = np.where(ahead, points[..., 2], np.inf)
    x = cfg.focal * points[..., 0] / depth + cfg.center[0]
    y = cfg.focal * points[..., 1] / depth + cfg.center[1]
    inside = ahead & (x >= 0) & (x < cfg.width) & (y >= 0) & (y < cfg.height)
    # Depth of the four pixels around the point: on a slope the point may lie behind some of them, never behind all.
    j = np.clip(np.floor(x - 0.5).astype(int), 0, cfg.width - 2)
    i = np.clip(np.floor(y - 0.5).astype(int), 0, cfg.height - 2)
    around = np.stack([z[i, j], z[i, j + 1], z[i + 1, j], z[i + 1, j + 1]])
    covered = tool[np.clip(y, 0, cfg.height - 1).astype(int), np.clip(x, 0, cfg.width - 1).astype(int)]
    # Points next to a silhouette count as occluded: there the four depths differ by more than a slope of 4.
    smooth = np.ptp(around, axis=0) < 0.3 + 4 * points[..., 2] / cfg.focal
    return inside & smooth & (points[..., 2] <= around.max(0) + 0.15) & ~covered


def shown_elsewhere(hits: NDArray[np.float32], seen: NDArray[np.bool_], tool: NDArray[np.bool_]) -> NDArray[np.bool_]:
    """(H, W) True behind the `tool` (H, W) where the tissue was seen at another time.

    Args:
        hits: (H, W, 3) material coordinates g_u, g_v of the tissue at each pixel, in [0, 1], and z (see `rasterize`).
        seen: (MH, MW) mesh vertices that some training frame shows.
    """
    rows, columns = seen.shape
    row = np.round(hits[..., 1] * (rows - 1)).astype(int)
    column = np.round(hits[..., 0] * (columns - 1)).astype(int)
    return tool & seen[row, column]
