"""Camera poses and camera matrices as files hold them, checked and converted to ours: `poses_bounds.npy`, matrices.

The rows of `poses_bounds.npy` are camera to world, 3x5 [R | t | (height, width, focal)], then near and far. `N` or `T`
frames.
"""

from __future__ import annotations

from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from ..core.checks import input_error
from .images import Size, read_values
from .reading import read_numpy, read_table

ROTATION_TOLERANCE = 1e-3
"""Largest entry of R^T R - I of a valid rotation: far above float32 rounding, far below a real scale."""
MATRIX_FILE = "intrinsics.txt"
POSES = "poses_bounds.npy"
POSES_HINT = "write one row of 17 numbers per frame: 3x5 [R | t | (H, W, focal)], near, far."
STILL_HINT = f"{POSES_HINT[:-1]}; for a static camera, set data.format to plain."
OFF_CENTER = 0.2  # largest distance of the principal point from the image center, as a share of the image's sides
SAME_SHAPE = 0.01  # largest relative difference of the scales along both sides
ROUNDED_PX = 1.0  # scaled images may differ from the exact shape by rounding


def demand_rotations(path: Path, rotations: NDArray[np.float64], where: str, fix: str) -> None:
    """Raise InputError if finite (N, 3, 3) matrices are not rotations; `where` names them in the message."""
    deviation = np.abs(rotations.transpose(0, 2, 1) @ rotations - np.eye(3)).max((1, 2))
    wrong = np.flatnonzero((deviation > ROTATION_TOLERANCE) | (np.linalg.det(rotations) <= 0))
    if wrong.size:
        raise input_error(path, f"rotations in {where}", f"another matrix in row {wrong[0]}", fix)


def world_to_camera(rotation: NDArray[np.float64], center: NDArray[np.float64]) -> NDArray[np.float64]:
    """(4, 4) transform from world to camera axes of a camera at `center`, (3,) mm, with axes as columns (3, 3)."""
    transform = np.eye(4)
    transform[:3, :3] = rotation.T
    transform[:3, 3] = -rotation.T @ center
    return transform


def identity_poses(count: int) -> list[NDArray[np.float64]]:
    """`world_to_camera` of a static camera at the origin, once per frame."""
    return [np.eye(4) for _ in range(count)]


def scale_of(path: Path, stated: tuple[float, float], size: Size, focal: float, fix: str, remarks: list[str]) -> float:
    """Factor by which numbers in a file for images of the `stated` size fit those of `size`, both (width, height), px.

    Files often hold the size of the original video beside smaller images; a remark tells what `focal`, px, becomes.
    """
    if stated == size:
        return 1.0
    got, want, scale = f"{stated[0]:g}x{stated[1]:g}", f"{size[0]}x{size[1]}", size[0] / max(stated[0], 1e-9)
    if stated[0] <= 0 or abs(scale * stated[1] - size[1]) > ROUNDED_PX:
        raise input_error(path, f"the size of the images, {want} px, or that shape", got, fix)
    remarks.append(
        f"{path}: its focal length, {focal:g} px, is for {got} px; scaled to {focal * scale:g} px for {want}"
    )
    return scale


def read_camera_matrix(path: Path) -> NDArray[np.float64]:
    """(3, 3) camera matrix, px, of a text file with 3x3, 3x4 or 4x4 numbers, or of `.npy` with 3x3.

    Pixel centers of the file are integers, ours are halves: 0.5 is added to the principal point.
    """
    fix = "write the 3x3 camera matrix of the images (fx 0 cx; 0 fy cy; 0 0 1)."
    if path.suffix == ".npy":
        rows, shapes = read_values(path).astype(np.float64), ((3, 3),)
    else:
        rows, shapes = read_table(path, fix), ((3, 3), (3, 4), (4, 4))
    fits = rows.shape in shapes and np.isfinite(rows).all()
    if not fits or min(rows[0, 0], rows[1, 1]) <= 0 or not np.array_equal(rows[2, :3], (0, 0, 1)):
        raise input_error(path, "a 3x3 camera matrix", f"shape {rows.shape} or other numbers", fix)
    matrix = rows[:3, :3].copy()
    matrix[:2, 2] += 0.5
    return matrix


def matrix_of_images(
    path: Path, matrix: NDArray[np.float64], size: Size, usual: Size, remarks: list[str]
) -> NDArray[np.float64]:
    """The matrix in px of images of this (width, height): as it is, or scaled from images of the `usual` size.

    The file does not state its size. The principal point tells which of both it is; a remark tells of a change.
    """
    if size == usual or _centered(matrix, size):
        return matrix
    across, down = size[0] / usual[0], size[1] / usual[1]
    if abs(across / down - 1) > SAME_SHAPE or not _centered(matrix, usual):
        got = f"cx {matrix[0, 2]:g}, cy {matrix[1, 2]:g}"
        fix = "scale fx, fy, cx, cy to the size of the images."
        raise input_error(path, f"a principal point near the center of {size[0]}x{size[1]} px", got, fix)
    scaled = np.diag([across, down, 1.0]) @ matrix
    was, now = f"{matrix[0, 0]:g} px is scaled to", f"{scaled[0, 0]:g} px for {size[0]}x{size[1]}"
    remarks.append(f"{path}: its principal point is that of {usual[0]}x{usual[1]} px; fx {was} {now}")
    return scaled


def _centered(matrix: NDArray[np.float64], size: Size) -> bool:
    return bool(np.abs(matrix[:2, 2] / size - 0.5).max() <= OFF_CENTER)


def lens_entries(matrix: NDArray[np.float64]) -> dict[str, float]:
    """The intrinsics of a (3, 3) camera matrix, px, as `sequence.json` names them."""
    fx, fy, cx, cy = (float(matrix[at]) for at in ((0, 0), (1, 1), (0, 2), (1, 2)))
    return {"fx": fx, "fy": fy, "cx": cx, "cy": cy}


def read_poses_bounds(path: Path, num_frames: int) -> NDArray[np.float64]:
    """(N, 3, 5) camera-to-world [R | t | (height, width, focal)] from `poses_bounds.npy`, checked."""
    if not path.exists():
        raise input_error(path, "camera poses", "no such file", STILL_HINT)
    stored = read_numpy(path, "a NumPy file", POSES_HINT)
    if not isinstance(stored, np.ndarray) or stored.shape != (num_frames, 17):
        raise input_error(path, f"shape ({num_frames}, 17)", str(getattr(stored, "shape", "an archive")), POSES_HINT)
    if not np.issubdtype(stored.dtype, np.number) or not np.isfinite(stored[:, :15].astype(np.float64)).all():
        raise input_error(path, "finite numbers", "NaN, infinity or other values", POSES_HINT)
    poses = stored[:, :15].astype(np.float64).reshape(-1, 3, 5)
    demand_rotations(path, poses[:, :, :3], "columns 0-2", POSES_HINT)
    return poses


def focal_at(path: Path, poses: NDArray[np.float64], size: Size, remarks: list[str]) -> float:
    """Focal length, px, of images of that (width, height), from the first of the stored poses of `poses_bounds.npy`."""
    height, width, focal = poses[0, :, 4].tolist()
    if focal <= 0:
        raise input_error(path, "a focal length > 0 px", f"{focal:g}", "correct row 0, column 14.")
    fix = "write the size and focal length of these images there, or fx, fy, cx, cy into sequence.json."
    return focal * scale_of(path, (width, height), size, focal, fix, remarks)


def pose_table(
    camera_to_world: NDArray[np.float64], height: int, width: int, focal: float, bounds: NDArray[np.float64]
) -> NDArray[np.float64]:
    """(T, 17) rows of `poses_bounds.npy`: 3x5 [R | t | (height, width, focal)], row-major, then near and far.

    `camera_to_world` is (T, 4, 4) in mm, with OpenCV axes; `bounds` (T, 2) the nearest and farthest depth, mm.
    """
    count = len(camera_to_world)
    size = np.broadcast_to([[height], [width], [focal]], (count, 3, 1))
    return np.concatenate([np.concatenate([camera_to_world[:, :3], size], 2).reshape(count, 15), bounds], 1)


def depth_bounds(stored: NDArray, scale: float) -> tuple[float, float]:
    """Nearest and farthest measured depth, mm, of stored values (0: missing); (0, 0) without any."""
    measured = stored[stored > 0]
    return (float(measured.min() * scale), float(measured.max() * scale)) if measured.size else (0.0, 0.0)


def scaled_poses(table: NDArray[np.float64], ratio: float) -> NDArray[np.float64]:
    """(T, 17) rows of `poses_bounds.npy` with their translations and bounds multiplied."""
    out = np.array(table, np.float64)
    out[:, [3, 8, 13, 15, 16]] *= ratio
    return out
