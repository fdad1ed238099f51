"""What a calibration says of one or two eyes, and how it is brought to the size of the pictures.

Matrices follow OpenCV (x right, y down, z forward) with one exception: the center of the top-left pixel is (0.5, 0.5)
here and (0, 0) in OpenCV, so principal points read from OpenCV's files are moved by half a pixel.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from ..data.reading import complaint

MIN_BASELINE_MM, MAX_BASELINE_MM = 1.0, 30.0
"""Stereo endoscopes have their eyes 3 to 6 mm apart; 30 mm leaves room for rigs on the bench."""
STILL_ROTATION = 1e-6
"""A rotation this close to none, with no distortion and no vertical offset, calls for no rectification."""


@dataclass(frozen=True)
class Eye:
    """One camera: how rays become pixels."""

    matrix: NDArray[np.float64]
    """(3, 3) K, px."""
    distortion: NDArray[np.float64]
    """(k,) OpenCV's coefficients, k in 0, 4, 5, 8, 12, 14."""


@dataclass(frozen=True)
class Calibration:
    """One eye, or two and how they stand to each other."""

    left: Eye
    right: Eye | None = None
    rotation: NDArray[np.float64] | None = None
    """(3, 3) R of x_right = R x_left + t."""
    translation_mm: NDArray[np.float64] | None = None
    """(3,) t, mm: about (-baseline, 0, 0)."""
    size: tuple[int, int] | None = None
    """(width, height) of the pictures of one eye it was made with, px; None if the file does not say."""
    layout: str | None = None
    """How the file says the eyes share a frame, in its own words."""

    @property
    def rectified(self) -> bool:
        """Whether the pictures can be matched row by row as they are."""
        if self.right is None or self.rotation is None or self.translation_mm is None:
            return False
        bent = any(np.any(eye.distortion) for eye in (self.left, self.right))
        turned = np.abs(self.rotation - np.eye(3)).max() > STILL_ROTATION
        shifted = np.abs(self.translation_mm[1:]).max() > STILL_ROTATION
        same = np.allclose(np.delete(self.left.matrix, 2, 1), np.delete(self.right.matrix, 2, 1))
        level = np.isclose(self.left.matrix[1, 2], self.right.matrix[1, 2])
        return bool(not (bent or turned or shifted) and same and level)

    def for_size(self, width: int, height: int, name: str) -> Calibration:
        """The calibration for pictures of another size that show the same.

        Args:
            name: of the calibration file, for the complaint.
        Raises:
            InputError: the two sizes have different proportions by more than a pixel in 100.
        """
        if self.size is None or self.size == (width, height):
            return self
        across, down = width / self.size[0], height / self.size[1]
        if abs(across / down - 1) > 0.01:
            raise complaint(
                name,
                f"pictures of {self.size[0]}x{self.size[1]} px, or the same proportions",
                f"{width}x{height}",
                "Give the calibration of this video, or its --layout.",
            )
        grow = np.diag([across, down, 1.0])
        scaled = [eye and replace(eye, matrix=grow @ eye.matrix) for eye in (self.left, self.right)]
        return replace(self, left=scaled[0], right=scaled[1], size=(width, height))


def check_pair(calibration: Calibration, name: str) -> float:
    """Baseline of a stereo calibration, mm.

    Raises:
        InputError: it has one eye only, the eyes are exchanged, stand above each other, or are implausibly far apart.
    """
    if calibration.right is None or calibration.rotation is None or calibration.translation_mm is None:
        raise complaint(name, "both eyes, R and T", "one eye", "Give a stereo calibration, or --layout mono.")
    x, y, z = calibration.translation_mm
    if abs(x) < max(abs(y), abs(z)):
        hint = "Only eyes side by side can be matched; turn the pictures and the calibration by 90 degrees."
        raise complaint(name, "T along x", f"({x:g}, {y:g}, {z:g}) mm", hint)
    if x > 0:
        hint = "Exchange left and right in the file, or give R and T of the right eye as seen from the left."
        raise complaint(name, "T[0] < 0 (x_right = R x_left + T)", f"{x:g} mm: left and right are swapped", hint)
    baseline = float(np.linalg.norm(calibration.translation_mm))
    if not MIN_BASELINE_MM <= baseline <= MAX_BASELINE_MM:
        hint = "Give the unit of T with --calibration-unit."
        raise complaint(name, f"a baseline of {MIN_BASELINE_MM:g} to {MAX_BASELINE_MM:g} mm", f"{baseline:g} mm", hint)
    return baseline
