"""Geometry on NumPy arrays: pixel grids, projection, back-projection, bilinear look-up, and how a surface is deformed.

Pixel (0, 0) is centered at (0.5, 0.5); `x = fx X / Z + cx`. Everything is in mm and px.
"""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import replace
from typing import Literal, NamedTuple, get_args

import numpy as np
from numpy.typing import NDArray

from .types import Camera

FARTHEST_MM = 1e6
"""Largest coordinate or depth that is accepted: a kilometer. Beyond it float32 does not resolve 0.1 mm."""


def length_unit(relative: bool) -> str:
    """The unit to show beside lengths: mm, or `rel.` where the scale of the depth is unknown or assumed."""
    return "rel." if relative else "mm"


def camera_to_world(cameras: Iterable[Camera]) -> NDArray[np.float64]:
    """(T, 4, 4) pose of each camera in the world, mm."""
    return np.linalg.inv(np.stack([camera.world_to_camera for camera in cameras])).astype(np.float64, copy=False)


def pixel_centers(width: int, height: int) -> NDArray[np.float32]:
    """(H, W, 2) coordinates (x, y) of the pixel centers, px."""
    x, y = np.meshgrid(np.arange(width, dtype=np.float32) + 0.5, np.arange(height, dtype=np.float32) + 0.5)
    return np.stack([x, y], -1)


def project(points: NDArray, camera: Camera) -> tuple[NDArray, NDArray]:
    """Project world points onto the image plane.

    Args:
        points: (..., 3) world coordinates, mm.
    Returns:
        (..., 2) pixel coordinates (meaningless where z <= 0) and (...,) camera-space z, mm.
    """
    in_camera = points @ camera.world_to_camera[:3, :3].T + camera.world_to_camera[:3, 3]
    z = in_camera[..., 2]
    safe_z = np.where(np.abs(z) < 1e-9, 1e-9, z)
    x = camera.fx * in_camera[..., 0] / safe_z + camera.cx
    y = camera.fy * in_camera[..., 1] / safe_z + camera.cy
    return np.stack([x, y], -1), z


def back_project(pixels: NDArray, depth: NDArray, camera: Camera) -> NDArray:
    """Back-project pixels to world points: the inverse of `project`.

    Args:
        pixels: (..., 2) pixel coordinates, centers at half integers.
        depth: (...,) camera-space z, mm.
    Returns:
        (..., 3) world coordinates, mm.
    """
    in_camera = np.stack(
        [
            (pixels[..., 0] - camera.cx) / camera.fx * depth,
            (pixels[..., 1] - camera.cy) / camera.fy * depth,
            depth,
        ],
        -1,
    )
    return (in_camera - camera.world_to_camera[:3, 3]) @ camera.world_to_camera[:3, :3]


def right_camera(camera: Camera, baseline_mm: float) -> Camera:
    """The camera that stands `baseline_mm` along the +x axis of `camera`, with its lens and turned like it."""
    moved = np.eye(4)
    moved[0, 3] = -baseline_mm
    return replace(camera, world_to_camera=moved @ camera.world_to_camera)


def share_of_right(camera: Camera, left: Camera, baseline_mm: float) -> float:
    """How much `camera` sees as the right camera does: 1 there, falls linearly to 0 at the distance of the left one."""
    away = np.linalg.norm(camera.center - right_camera(left, baseline_mm).center)
    return float(max(0, 1 - away / baseline_mm))


def expected_depth(depth: NDArray, alpha: NDArray, min_alpha: float = 0.5) -> NDArray[np.float32]:
    """(H, W) z of the rendered surface, mm: the sum of weight * z over alpha; 0 where alpha < `min_alpha`."""
    covered = alpha >= min_alpha
    return np.where(covered, depth / np.where(covered, alpha, 1), 0).astype(np.float32)


def bilinear(image: NDArray, pixels: NDArray) -> NDArray:
    """Bilinear interpolation with values at pixel centers; outside, the border value is repeated.

    Args:
        image: (H, W) or (H, W, C).
        pixels: (..., 2) coordinates (x, y), px.
    Returns:
        (...) or (..., C) interpolated values.
    """
    height, width = image.shape[:2]
    x = np.clip(pixels[..., 0] - 0.5, 0, width - 1)
    y = np.clip(pixels[..., 1] - 0.5, 0, height - 1)
    x0, y0 = np.floor(x).astype(np.intp), np.floor(y).astype(np.intp)
    x1, y1 = np.minimum(x0 + 1, width - 1), np.minimum(y0 + 1, height - 1)
    fx, fy = x - x0, y - y0
    if image.ndim == 3:
        fx, fy = fx[..., None], fy[..., None]
    top = image[y0, x0] * (1 - fx) + image[y0, x1] * fx
    bottom = image[y1, x0] * (1 - fx) + image[y1, x1] * fx
    return top * (1 - fy) + bottom * fy


def cells_at(pixels: NDArray, width: int, height: int) -> tuple[NDArray[np.intp], NDArray[np.intp]]:
    """Column and row (P,) of the pixel in which each position (P, 2), px, lies, clamped to the image."""
    x, y = np.clip(np.floor(pixels), 0, (width - 1, height - 1)).astype(np.intp).T
    return x, y


def unit_vectors(vectors: NDArray) -> NDArray[np.float64]:
    """(..., 3) vectors of length 1 in the same directions; 0 stays 0."""
    return np.asarray(vectors / np.maximum(np.linalg.norm(vectors, axis=-1, keepdims=True), 1e-12), np.float64)


def quaternion_to_matrix(quats: NDArray) -> NDArray:
    """Rotation matrices of quaternions (w, x, y, z) of any non-zero length.

    Args:
        quats: (..., 4).
    Returns:
        (..., 3, 3).
    """
    w, x, y, z = np.moveaxis(quats / np.linalg.norm(quats, axis=-1, keepdims=True), -1, 0)
    rows = [
        [1 - 2 * (y * y + z * z), 2 * (x * y - w * z), 2 * (x * z + w * y)],
        [2 * (x * y + w * z), 1 - 2 * (x * x + z * z), 2 * (y * z - w * x)],
        [2 * (x * z - w * y), 2 * (y * z + w * x), 1 - 2 * (x * x + y * y)],
    ]
    return np.stack([np.stack(row, -1) for row in rows], -2)


Convention = Literal["opencv", "opengl", "llff", "world-to-camera", "world-to-camera-opengl"]
"""In which files hold camera poses. Ours is `opencv` (x right, y down, z forward); it and `opengl` (x right, y up, z
backward; Blender, NeRF) are camera-to-world. `llff` has columns down, right, back. The others are inverses of the
first two."""
CONVENTIONS: tuple[Convention, ...] = get_args(Convention)


def to_ours(poses: NDArray[np.float64], convention: Convention, unit_mm: float = 1.0) -> NDArray[np.float64]:
    """(T, 4, 4) camera-to-world in mm, OpenCV axes, of rigid transforms (T, 4, 4) in another convention.

    Args:
        unit_mm: length of a unit of their translations.
    """
    ours = poses.copy()
    ours[:, :3, 3] *= unit_mm
    if convention.startswith("world-to-camera"):
        rotation = ours[:, :3, :3].transpose(0, 2, 1)
        ours[:, :3, 3] = -(rotation @ ours[:, :3, 3:])[..., 0]
        ours[:, :3, :3] = rotation
    if convention.endswith("opengl"):
        ours[:, :3, 1:3] *= -1
    if convention == "llff":
        down, right, back = (ours[:, :3, i].copy() for i in range(3))
        ours[:, :3, 0], ours[:, :3, 1], ours[:, :3, 2] = right, down, -back
    return ours


class Strain(NamedTuple):
    """Deformation of pieces of a surface since some time at which it was undeformed; NaN where unknown."""

    stretch: NDArray[np.float64]
    """(..., 2) largest and smallest principal stretch: length after over length before; 1: unchanged."""
    direction: NDArray[np.float64]
    """(..., 3) unit vector on the undeformed surface along which the stretch is largest; its sign says nothing."""

    @property
    def area(self) -> NDArray[np.float64]:
        """(...,) area after over area before."""
        return self.stretch.prod(-1)


def strain_of(gradient: NDArray, axes: NDArray) -> Strain:
    """The strain of a deformation gradient.

    Args:
        gradient: (..., 3, 2) takes positions along two perpendicular directions of the undeformed surface to positions.
        axes: (..., 3, 2) these directions, unit vectors, as columns.
    """
    _, stretch, rows = np.linalg.svd(gradient, full_matrices=False)
    return Strain(stretch, (axes @ rows[..., 0, :, None])[..., 0])


def strain_between(before: NDArray, after: NDArray) -> Strain:
    """The strain that takes tangents to tangents.

    Args:
        before, after: (..., 3, 2) two tangents of a surface, as columns, along the same material lines.
    """
    axes, lengths = np.linalg.qr(before)
    return strain_of(after @ np.linalg.inv(lengths), axes)
