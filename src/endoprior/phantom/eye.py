"""A camera of the phantom: where it is and how it is turned, in the axes of another one.

The endoscope's left camera is placed in the world, the others in the axes of the left camera of the same frame.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray


@dataclass(frozen=True)
class Eye:
    """One camera; its intrinsics are those of the endoscope."""

    center: NDArray[np.float64]
    """(3,) mm."""
    turn: NDArray[np.float64]
    """(3, 3) rotation of the camera's axes to the outer ones."""

    @staticmethod
    def moved(x_mm: float) -> Eye:
        """A camera moved to the right."""
        return Eye(np.array([x_mm, 0.0, 0.0]), np.eye(3))

    @staticmethod
    def posed(camera_to_world: NDArray[np.float64]) -> Eye:
        """The camera with a pose (4, 4)."""
        return Eye(camera_to_world[:3, 3], camera_to_world[:3, :3])

    def sees(self, points: NDArray) -> NDArray[np.float64]:
        """Points (..., 3) of the outer axes in the axes of this camera, mm."""
        return (points - self.center) @ self.turn

    @property
    def world_to_camera(self) -> NDArray[np.float64]:
        """(4, 4) rigid transform from the outer axes."""
        pose = np.eye(4)
        pose[:3, :3], pose[:3, 3] = self.turn.T, -self.turn.T @ self.center
        return pose


STILL = Eye.moved(0.0)
"""A camera where the outer axes are."""
