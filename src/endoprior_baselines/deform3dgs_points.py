"""Where Deform3DGS starts: the surface of the first frame, and what other frames show that it does not.

As released (`Deform3DGS@b06f0a5`, facts in docs/methods.md), but from training frames only.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from endoprior.core.checks import input_error
from endoprior.core.geometry import back_project, project
from endoprior.core.types import Frame
from endoprior.initialization.sampling import MIN_POINTS, PointCloud, concatenated, has_surface

MOVING_PERCENTILE = 95.0
"""A pixel moves if its gray level departs from its mean over time by more than this percentile of all departures."""
MANY_FRAMES = 150
"""With more frames, every second one adds points."""
FEWEST_NEW = 50
"""A frame that shows no more new pixels adds none."""
SHARE = 0.1
"""Of the new pixels of a frame that are added, and of all points that are kept at the end."""
MOST, DRAWN = 600_000, 500_000
"""Of more points than the first number, so many are drawn."""


def first_points(frames: Sequence[Frame], seed: int) -> PointCloud:
    """Points of the first frame, and of what is uncovered later or moves there.

    Args:
        frames: training frames, in order.
        seed: equal seeds give equal points.
    Returns:
        A tenth of the points, without repetition of pixels of the first frame.
    Raises:
        InputError: fewer than 4 points.
    """
    rng, first = np.random.default_rng(seed), frames[0]
    seen = _surface(first, 0.1, 99.9)
    covered, moving = seen.copy(), _moving(frames)
    clouds = [_points(first, 0, np.flatnonzero(seen))]
    step = 2 if len(frames) > MANY_FRAMES else 1
    for position in range(1, len(frames), step):
        frame = frames[position]
        flat = np.flatnonzero(_surface(frame, 3.0, 99.8))
        cloud = _points(frame, position, flat)
        inside, cells = _cells(cloud.points, first)
        new = inside.copy()
        new[inside] = ~covered.reshape(-1)[cells[inside]] | moving.reshape(-1)[cells[inside]]
        if np.count_nonzero(new) > FEWEST_NEW:
            rows = np.flatnonzero(new)
            clouds.append(cloud.subset(rng.choice(rows, int(SHARE * len(rows)))))
            covered.reshape(-1)[cells[new]] = True
    cloud = concatenated(clouds)
    if len(cloud) > MOST:
        cloud = cloud.subset(rng.integers(len(cloud), size=DRAWN))
    cloud = cloud.subset(np.sort(rng.choice(len(cloud), int(SHARE * len(cloud)), replace=False)))
    if len(cloud) < MIN_POINTS:
        want = f"at least {MIN_POINTS} points, a tenth of the tissue pixels with depth"
        raise input_error("initialization", want, str(len(cloud)), "Check masks and depth: `endoprior check DATA`.")
    return cloud


def _surface(frame: Frame, low: float, high: float) -> NDArray[np.bool_]:
    """(H, W) tissue with a depth between two percentiles of all depths of the frame."""
    depths = frame.depth[frame.depth_valid]
    if not len(depths):
        return np.zeros_like(frame.tissue_mask)
    near, far = np.percentile(depths, [low, high])
    return frame.tissue_mask & has_surface(frame) & (frame.depth >= near) & (frame.depth <= far)


def _moving(frames: Sequence[Frame]) -> NDArray[np.bool_]:
    """(H, W) pixels of the first frame whose gray level differs much from its mean over time."""
    mean = np.zeros(frames[0].tissue_mask.shape)
    for frame in frames:
        mean += frame.rgb_u8.mean(-1) / len(frames)
    away = np.abs(frames[0].rgb_u8.mean(-1) - mean)
    departed = away[away > 0]
    return away > np.percentile(departed, MOVING_PERCENTILE) if len(departed) else np.zeros(away.shape, bool)


def _points(frame: Frame, position: int, flat: NDArray[np.intp]) -> PointCloud:
    """World points of pixels, given by flat index."""
    v, u = np.divmod(flat, frame.camera.width)
    points = back_project(np.stack([u, v], -1) + 0.5, frame.depth[v, u].astype(np.float64), frame.camera)
    colors = frame.rgb_u8[v, u].astype(np.float32) / np.float32(255)
    return PointCloud(points.astype(np.float32), colors, np.full(len(flat), position, np.int32))


def _cells(points: NDArray[np.float32], first: Frame) -> tuple[NDArray[np.bool_], NDArray[np.intp]]:
    """Which of P points the first frame's camera sees, (P,), and the flat index of their pixel there, (P,)."""
    pixels, z = project(points.astype(np.float64), first.camera)
    camera = first.camera
    inside = (z > 0) & (pixels >= 0).all(1) & (pixels < [camera.width, camera.height]).all(1)
    cells = np.where(inside[:, None], pixels, 0).astype(np.intp)
    return inside, cells[:, 1] * camera.width + cells[:, 0]
