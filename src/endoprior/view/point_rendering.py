"""Render a point cloud as small squares, nearest on top."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from ..core.geometry import project
from ..core.types import Camera

LARGEST_PX = 6
"""Side of the largest square."""


def render_points(
    points: NDArray, colors: NDArray[np.uint8], size: float, camera: Camera
) -> tuple[NDArray[np.uint8], NDArray[np.float32]]:
    """Render a point cloud.

    Args:
        points: (P, 3) world axes, mm. colors: (P, 3). size: width of a point, mm.
    Returns:
        (H, W, 3) image, black where there is no point, and (H, W) z of the visible points, mm, 0 where there is none.
    """
    picture = np.zeros((camera.height, camera.width, 3), np.uint8)
    depth = np.zeros((camera.height, camera.width), np.float32)
    pixels, z = project(points.astype(np.float64), camera)
    inside = (z > 1e-3) & ((pixels >= 0) & (pixels < (camera.width, camera.height))).all(-1)
    pixels, z, colors = pixels[inside], z[inside], colors[inside]
    if not len(z):
        return picture, depth
    far_to_near = np.argsort(-z, kind="stable")
    pixels, z, colors = pixels[far_to_near], z[far_to_near], colors[far_to_near]
    side = int(np.clip(np.ceil(camera.fy * size / np.median(z)), 1, LARGEST_PX))
    corner = np.floor(pixels - (side - 1) / 2).astype(int)
    # Far to near: for repeated indices NumPy keeps the last value.
    offsets = np.stack(np.meshgrid(np.arange(side), np.arange(side)), -1).reshape(-1, 2)
    x, y = np.moveaxis(corner[:, None] + offsets, -1, 0)
    seen = (x >= 0) & (x < camera.width) & (y >= 0) & (y < camera.height)
    at = y[seen], x[seen]
    picture[at] = np.broadcast_to(colors[:, None], (*x.shape, 3))[seen]
    depth[at] = np.broadcast_to(z[:, None], x.shape)[seen]
    return picture, depth
