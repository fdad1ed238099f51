"""Conventions in which files hold camera poses, and ours: camera-to-world, OpenCV axes (x right, y down, z forward)."""

from __future__ import annotations

from typing import Literal, get_args

import numpy as np
from numpy.typing import NDArray

Convention = Literal["opencv", "opengl", "llff", "world-to-camera", "world-to-camera-opengl"]
"""`opencv` and `opengl` (x right, y up, z backward; Blender, NeRF) are camera-to-world. `llff` has columns down, right,
back. The others are the inverse of the first two."""
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
