"""How a camera moves, told from its path: how far its turns and its ways shift the image, and whether images agree.

A step is split into what turning, moving sideways and moving ahead do to a plane at the tissue's depth.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from .adjust import back_projected
from .path_facts import PathMotion
from .tracks import CameraPath, TrackingCamera, Tracks

GAP = 5  # frames between two poses that are compared: jitter of single frames is smaller than motion over them


def path_motion(path: CameraPath, tracks: Tracks, lens: TrackingCamera, size: tuple[int, int]) -> PathMotion:
    """Measure a path. Args: tracks: whose depths were used. lens: with the focal length of the path. size: px."""
    count, poses = len(path.explained), np.linalg.inv(path.camera_to_world)
    depth = np.array([np.median(z[z > 0]) if (z > 0).any() else np.nan for z in tracks.depths]) * path.depth_scale
    x, y = np.meshgrid(np.array([1, 3, 5]) * size[0] / 6, np.array([1, 3, 5]) * size[1] / 6)
    grid = np.stack([x.ravel(), y.ravel()], 1)

    def shift(f: int, motion: NDArray) -> float:
        points = back_projected(lens.matrix, np.eye(4), grid, np.full(len(grid), depth[f]))
        there = points @ motion[:3, :3].T + motion[:3, 3]
        pixels = there @ lens.matrix.T
        return float(np.hypot(*(pixels[:, :2] / np.maximum(pixels[:, 2:], 1e-3) - grid).T).mean())

    def between(f: int, gap: int) -> NDArray | None:
        known = f + gap < count and path.explained[f] and path.explained[f + gap] and np.isfinite(depth[f])
        return poses[f + gap] @ np.linalg.inv(poses[f]) if known else None

    shifts = [np.nan if (motion := between(f, 1)) is None else shift(f, motion) for f in range(count - 1)]
    parts, ways = [], []
    for f in range(count):
        if (motion := between(f, GAP)) is None:
            continue
        turn, aside, along = (np.eye(4) for _ in range(3))
        turn[:3, :3], aside[:2, 3], along[2, 3] = motion[:3, :3], motion[:2, 3], motion[2, 3]
        parts.append([shift(f, part) for part in (turn, aside, along)])
        ways.append(-motion[:3, 3])
    way = np.array(ways).reshape(-1, 3)
    along, length = np.abs(way[:, 2]).sum(), np.linalg.norm(way, axis=1).sum()
    axial, ahead = (float(part / max(of, 1e-9)) for part, of in ((along, length), (way[:, 2].sum(), along)))
    return PathMotion(np.array(shifts), np.array(parts).reshape(-1, 3), axial, ahead, lens.px)
