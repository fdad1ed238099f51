"""What camera tracking reads of a frame, and what it returns. `T` frames."""

from __future__ import annotations

from dataclasses import dataclass, field, replace

import numpy as np
from numpy.typing import NDArray


@dataclass(frozen=True)
class PoseInput:
    """One frame for camera tracking."""

    rgb_u8: NDArray[np.uint8]
    """(H, W, 3)."""
    tissue_mask: NDArray[np.bool_]
    """(H, W) True outside tools."""
    depth: NDArray[np.float32]
    """(H, W) mm, 0 where missing."""


@dataclass(frozen=True)
class Lens:
    """A pinhole camera whose depth was measured; pixel centers are counted from 0, as in OpenCV."""

    matrix: NDArray[np.float64]
    """(3, 3) K, px."""
    width: int
    """Of the image, px."""
    depth_is_relative: bool
    """Each frame's depth has a scale of its own."""
    baseline_mm: float | None = None
    """Distance between the cameras that measured the depth, mm."""

    @classmethod
    def centered_at_half(
        cls, matrix: NDArray[np.float64], width: int, depth_is_relative: bool, baseline_mm: float | None = None
    ) -> Lens:
        """From K with the left-most pixel centered at 0.5."""
        opencv = np.array(matrix, np.float64)
        opencv[:2, 2] -= 0.5
        return cls(opencv, width, depth_is_relative, baseline_mm)

    def with_focal(self, factor: float) -> Lens:
        """The lens with both focal lengths multiplied."""
        matrix = self.matrix.copy()
        matrix[[0, 1], [0, 1]] *= factor
        return replace(self, matrix=matrix)

    @property
    def px(self) -> float:
        """Length of a pixel of an image 640 px wide, in px of this one: thresholds are multiples of it."""
        return self.width / 640


@dataclass(frozen=True)
class CameraPath:
    """Poses of all frames."""

    camera_to_world: NDArray[np.float64]
    """(T, 4, 4), translation in mm; an unexplained frame has the pose of the frame before it."""
    explained: NDArray[np.bool_]
    """(T,) whether the pose is linked to those of the other frames."""
    depth_scale: NDArray[np.float64]
    """(T,) factor that makes the depth of the frame agree with the path; 1 for depth in mm."""
    method: str = "file"
    """Where the poses come from."""
    focal_factor: float = 1.0
    """Refined focal length, as a multiple of the given one."""
    translation_std: NDArray[np.float64] | None = None
    """(T,) standard deviation of the camera center, mm; NaN where unexplained."""
    rotation_std: NDArray[np.float64] | None = None
    """(T,) standard deviation of the rotation, degrees."""
    still: NDArray[np.bool_] | None = None
    """(T,) whether the pose is a copy, because the camera rests."""
    breathes: bool = False
    """Whether periodic motion of the tissue was told apart from the camera's."""
    notes: list[str] = field(default_factory=list)
    """Notes for the user, one line each."""
