"""Camera poses as files hold them: checked, and converted to `world_to_camera`. `N` frames."""

from __future__ import annotations

from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from ..core.checks import input_error

ROTATION_TOLERANCE = 1e-3
"""Largest entry of R^T R - I of a valid rotation: far above float32 rounding, far below a real scale."""


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
