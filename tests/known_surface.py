"""A tilted, painted plane in the world, as cameras see it: for tests of readers' cameras and depth."""

from __future__ import annotations

import cv2
import numpy as np
from scipy.ndimage import map_coordinates

from endoprior.data import FrameSequence

NORMAL, OFFSET = np.array([0.2, -0.3, 1.0]), 75.0
"""The plane is where NORMAL . X = OFFSET, mm, world axes."""


def turned(x: float = 0.0, y: float = 0.0, z: float = 0.0) -> np.ndarray:
    """(3, 3) rotation by these angles about the axes, degrees."""
    return cv2.Rodrigues(np.radians([x, y, z]))[0]


def pose(rotation: np.ndarray, center: tuple[float, float, float]) -> np.ndarray:
    """(4, 4) camera-to-world of a camera at `center`, mm, whose axes are the columns of a rotation (3, 3)."""
    matrix = np.eye(4)
    matrix[:3, :3], matrix[:3, 3] = rotation, center
    return matrix


def seen(matrix: np.ndarray, camera_to_world: np.ndarray, size: tuple[int, int], center: float = 0.5):
    """What a camera sees of the plane: color (H, W, 3) uint8 and depth (H, W) mm.

    Args:
        matrix: (3, 3) K, px.
        size: (width, height), px.
        center: of the left-most pixel in the px of K: 0.5, or 0 as in OpenCV.
    """
    columns, rows = np.meshgrid(np.arange(size[0]) + center, np.arange(size[1]) + center)
    rays = np.stack([columns, rows, np.ones_like(columns)], -1) @ np.linalg.inv(matrix).T
    return of_rays(rays, camera_to_world)


def seen_through_lens(matrix: np.ndarray, distortion: np.ndarray, camera_to_world: np.ndarray, size: tuple[int, int]):
    """As `seen`, finely painted, through a lens with OpenCV's distortion; the left-most pixel is centered at 0."""
    columns, rows = np.meshgrid(np.arange(size[0], dtype=np.float64), np.arange(size[1], dtype=np.float64))
    at = np.stack([columns, rows], -1).reshape(-1, 1, 2)
    flat = cv2.undistortPoints(at, matrix, distortion, criteria=(3, 100, 1e-12))
    rays = np.concatenate([flat.reshape(-1, 2), np.ones((flat.shape[0], 1))], 1).reshape(size[1], size[0], 3)
    return of_rays(rays, camera_to_world, fine=30)


def off_the_plane(sequence: FrameSequence, index: int) -> float:
    """Distance from the plane, mm, below which 95 % of the tissue of a frame lies by its depth and camera."""
    points, _ = _lifted(sequence, index)
    return float(np.quantile(np.abs(points @ NORMAL - OFFSET) / np.linalg.norm(NORMAL), 0.95))


def color_change(sequence: FrameSequence, first: int, second: int) -> float:
    """Levels by which 95 % of the points of one frame change their color where they land in another frame."""
    points, colors = _lifted(sequence, first)
    camera, frame = sequence.camera(second), sequence.frame(second)
    moved = points @ camera.world_to_camera[:3, :3].T + camera.world_to_camera[:3, 3]
    at = moved[:, :2] / moved[:, 2:] * (camera.fx, camera.fy) + (camera.cx, camera.cy)
    inside = ((at > 1) & (at < (camera.width - 1, camera.height - 1))).all(1)
    assert inside.mean() > 0.3  # both frames show the same part
    places = (at[inside] - 0.5).T[::-1]

    def there(image: np.ndarray) -> np.ndarray:
        return map_coordinates(image.astype(np.float64), places, order=1)

    tissue = there(frame.tissue_mask) > 0.99
    found = np.stack([there(frame.rgb_u8[..., channel]) for channel in range(3)], 1)
    return float(np.quantile(np.abs(found - colors[inside])[tissue].max(1), 0.95))


def of_rays(rays: np.ndarray, camera_to_world: np.ndarray, fine: float = 0):
    """Color and depth of the plane on rays (H, W, 3) of a camera, z = 1. Args: fine: levels of a fine pattern."""
    turn, start = camera_to_world[:3, :3], camera_to_world[:3, 3]
    directions = rays @ turn.T
    depth = (OFFSET - NORMAL @ start) / (directions @ NORMAL)
    x, y, _ = np.moveaxis(start + directions * depth[..., None], -1, 0)
    color = np.stack([140 + 60 * np.sin(x / 5), 90 + 50 * np.sin(y / 4 + 1), 80 + 40 * np.sin((x + y) / 7)], -1)
    color += fine * (np.sin(2.1 * x + 0.4 * y) * np.sin(1.7 * y - 0.6 * x))[..., None]
    return np.rint(color).astype(np.uint8), depth


def _lifted(sequence: FrameSequence, index: int):
    """World points (P, 3), mm, and colors (P, 3) of the tissue of a frame that has depth."""
    frame, camera = sequence.frame(index), sequence.camera(index)
    rows, columns = np.nonzero(frame.tissue_mask & frame.depth_valid)
    z = frame.depth[rows, columns].astype(np.float64)
    at = np.stack([(columns + 0.5 - camera.cx) / camera.fx * z, (rows + 0.5 - camera.cy) / camera.fy * z, z], 1)
    to_world = np.linalg.inv(camera.world_to_camera)
    points = at @ to_world[:3, :3].T + to_world[:3, 3]
    return points, frame.rgb_u8[rows, columns].astype(np.float64)
