"""Residuals of one observation: reprojection in px, and measured depth in disparity; with their derivatives.

`N` observations. A pose is world-to-camera; it changes to [exp(w), v] o pose for a small step (w, v) in camera axes.
"""

from __future__ import annotations

import cv2
import numpy as np
from numpy.typing import NDArray

NEAREST_MM = 1e-3
"""Points nearer than this, or behind the camera, are held at it: finite residuals, far from any inlier."""


def residuals(
    matrix: NDArray, poses: NDArray, points: NDArray, pixels: NDArray, inverse_depth: NDArray, sigma: NDArray
) -> NDArray[np.float64]:
    """(N, 3) standardized residuals: u, v, and inverse depth 1/z (Eq.: disparity = f b / z).

    Args:
        matrix: (3, 3) K, px.
        poses: (N, 4, 4) or (4, 4) world-to-camera.
        points: (N, 3) world points, mm.
        pixels: (N, 2) where they were seen, px.
        inverse_depth: (N,) 1 / measured depth, 1/mm.
        sigma: (N, 2) standard deviation of a pixel, px, and of the inverse depth, 1/mm; inf where none was measured.
    """
    seen = _in_camera(poses, points)
    z = np.maximum(seen[:, 2], NEAREST_MM)
    u = matrix[0, 0] * seen[:, 0] / z + matrix[0, 2] - pixels[:, 0]
    v = matrix[1, 1] * seen[:, 1] / z + matrix[1, 2] - pixels[:, 1]
    return np.stack([u / sigma[:, 0], v / sigma[:, 0], (1 / z - inverse_depth) / sigma[:, 1]], 1)


def derivatives(
    matrix: NDArray, poses: NDArray, points: NDArray, sigma: NDArray
) -> tuple[NDArray[np.float64], NDArray[np.float64], NDArray[np.float64]]:
    """Derivatives of `residuals`: (N, 3, 6) by the pose step (w, v), (N, 3, 3) by the point, (N, 3) by log f."""
    seen = _in_camera(poses, points)
    x, y = seen[:, 0], seen[:, 1]
    z = np.maximum(seen[:, 2], NEAREST_MM)
    zero = np.zeros_like(z)
    a, b = matrix[0, 0] / z / sigma[:, 0], matrix[1, 1] / z / sigma[:, 0]
    by_seen = np.stack([a, zero, -a * x / z, zero, b, -b * y / z, zero, zero, -1 / (z * z * sigma[:, 1])], 1).reshape(
        -1, 3, 3
    )
    turned = np.stack([zero, seen[:, 2], -y, -seen[:, 2], zero, x, y, -x, zero], 1).reshape(-1, 3, 3)  # -[X]_x
    by_pose = np.concatenate([by_seen @ turned, by_seen], 2)
    by_focal = np.stack([a * x, b * y, zero], 1)
    return by_pose, by_seen @ poses[..., :3, :3], by_focal


def moved(poses: NDArray, steps: NDArray) -> NDArray[np.float64]:
    """(K, 4, 4) poses after steps (K, 6) of rotation, rad, and translation, mm, in camera axes."""
    out = poses.copy()
    for k, step in enumerate(steps):
        turn = cv2.Rodrigues(step[:3])[0]
        out[k, :3, :3] = turn @ poses[k, :3, :3]
        out[k, :3, 3] = turn @ poses[k, :3, 3] + step[3:]
    return out


def back_projected(matrix: NDArray, pose: NDArray, pixels: NDArray, z: NDArray) -> NDArray[np.float64]:
    """(N, 3) world points of pixels (N, 2) at depth z (N,) mm, seen from a world-to-camera pose."""
    x = (pixels[:, 0] - matrix[0, 2]) / matrix[0, 0] * z
    y = (pixels[:, 1] - matrix[1, 2]) / matrix[1, 1] * z
    return (np.stack([x, y, z], 1) - pose[:3, 3]) @ pose[:3, :3]


def geman_mcclure(squared: NDArray, width: float) -> NDArray[np.float64]:
    """Weight in (0, 1] of residuals with these squares: (c^2 / (c^2 + r^2))^2."""
    return (width * width / (width * width + squared)) ** 2


def _in_camera(poses: NDArray, points: NDArray) -> NDArray[np.float64]:
    return (poses[..., :3, :3] @ points[:, :, None])[:, :, 0] + poses[..., :3, 3]
