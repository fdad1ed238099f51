"""Points on a grid of pixels, where frames show tissue with depth."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from endoprior.core.checks import input_error
from endoprior.core.geometry import back_project
from endoprior.core.types import Frame
from endoprior.initialization.sampling import MIN_POINTS, PointCloud, concatenated, has_surface


def grid_points(frames: Sequence[Frame], every_px: int, first_px: int) -> PointCloud:
    """A point at every n-th pixel along both axes, from the first frame that shows tissue with depth there.

    Args:
        frames: in order. every_px: n. first_px: row and column of the first pixel.
    Raises:
        InputError: fewer than 4 points.
    """
    grid = np.zeros_like(frames[0].tissue_mask)
    grid[first_px::every_px, first_px::every_px] = True
    clouds = []
    for position, frame in enumerate(frames):
        v, u = np.nonzero(grid & frame.tissue_mask & has_surface(frame))
        grid[v, u] = False
        points = back_project(np.stack([u, v], -1) + 0.5, frame.depth[v, u].astype(np.float64), frame.camera)
        colors = frame.rgb_u8[v, u].astype(np.float32) / np.float32(255)
        clouds.append(PointCloud(points.astype(np.float32), colors, np.full(len(v), position, np.int32)))
    cloud = concatenated(clouds)
    if len(cloud) < MIN_POINTS:
        want = f"at least {MIN_POINTS} points on tissue with depth"
        raise input_error("initialization", want, str(len(cloud)), "Check masks and depth: `endoprior check DATA`.")
    return cloud
