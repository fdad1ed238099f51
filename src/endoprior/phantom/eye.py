"""A camera of the phantom: where it is and how it is turned, in the axes of the left endoscope camera."""

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
    """(3, 3) rotation of the camera's axes to the left camera's."""

    @staticmethod
    def moved(x_mm: float) -> Eye:
        """The left camera, moved to the right."""
        return Eye(np.array([x_mm, 0.0, 0.0]), np.eye(3))

    def sees(self, points: NDArray) -> NDArray[np.float64]:
        """Points (..., 3) of the left camera's axes in the axes of this camera, mm."""
        return (points - self.center) @ self.turn

    @property
    def world_to_camera(self) -> NDArray[np.float64]:
        """(4, 4) rigid transform from the left camera's axes."""
        pose = np.eye(4)
        pose[:3, :3], pose[:3, 3] = self.turn.T, -self.turn.T @ self.center
        return pose
