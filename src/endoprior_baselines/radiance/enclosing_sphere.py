"""The sphere that holds the tissue of all training frames, which EndoSurf makes its unit."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from endoprior.compute.neighbors import nearest
from endoprior.core.geometry import back_project, pixel_centers

from .frames import RayFrames

SHARE = 0.005
"""Share of the measured pixels of a frame that are taken, ..."""
FEWEST = 100
"""... but at least about so many: a sphere around a few points of a small frame would miss most of the tissue."""
LOW, HIGH = 3.0, 99.9
"""Percentiles of all measured depths between which a point counts: edges of tools are often measured too near."""
NEIGHBORS, SPREAD = 5, 20.0
"""A point stays if this many others lie within so many times the mean distance to the nearest one."""
FILLED = 0.8
"""Distance of the farthest point from the center, as a share of the radius."""


def enclosing_sphere(frames: RayFrames) -> tuple[NDArray[np.float64], float]:
    """Center (3,) in world axes and radius, mm."""
    ends = frames.depth_percentiles(LOW, HIGH, missing=False)
    points = without_outliers(np.concatenate([_points(frames, k, ends) for k in frames.usable]))
    center = (points.min(0) + points.max(0)) / 2
    radius = float(np.linalg.norm(points - center, axis=1).max()) / FILLED
    return center, radius or 1.0


def _points(frames: RayFrames, position: int, ends: tuple[float, float]) -> NDArray[np.float64]:
    """Evenly chosen measured points of a frame; a fixed choice, since nothing depends on which."""
    depth, camera = frames.depth(position), frames.frame(position).camera
    pixels = np.flatnonzero((depth > 0) & (depth >= ends[0]) & (depth <= ends[1]))
    chosen = pixels[:: max(1, min(int(1 / SHARE), len(pixels) // FEWEST))]
    at = pixel_centers(camera.width, camera.height).reshape(-1, 2)[chosen].astype(np.float64)
    return without_outliers(back_project(at, depth.ravel()[chosen].astype(np.float64), camera))


def without_outliers(points: NDArray[np.float64]) -> NDArray[np.float64]:
    """The points (P, 3) that have neighbors; all of them if there are too few to tell, or if none would stay."""
    if len(points) <= NEIGHBORS:
        return points
    _, distance = nearest(np.ascontiguousarray(points), NEIGHBORS)
    stays = distance[:, -1] <= SPREAD * distance[:, 0].mean()
    return points[stays] if stays.any() else points
