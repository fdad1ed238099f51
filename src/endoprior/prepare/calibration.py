"""Calibration of one or two cameras.

Matrices follow OpenCV (x right, y down, z forward) with one exception: the center of the top-left pixel is (0.5, 0.5)
here and (0, 0) in OpenCV. Principal points from OpenCV files are therefore moved by half a pixel.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from ..core.checks import input_error

MIN_BASELINE_MM, MAX_BASELINE_MM = 1.0, 30.0
"""The baseline of stereo endoscopes is 3 to 6 mm; bench setups reach 30 mm."""
NEGLIGIBLE = 1e-6
"""Rotation, or vertical offset in mm, below which a pair without distortion counts as rectified."""


@dataclass(frozen=True)
class Intrinsics:
    """Camera matrix and lens distortion of one camera."""

    matrix: NDArray[np.float64]
    """(3, 3) K, px."""
    distortion: NDArray[np.float64]
    """(k,) OpenCV distortion coefficients, k in 0, 4, 5, 8, 12, 14; of a fisheye k1..k4."""
    fisheye: bool = False
    """OpenCV's fisheye model (equidistant, Kannala-Brandt): bent even where all coefficients are 0."""

    @property
    def bent(self) -> bool:
        """Whether straight lines become curves."""
        return self.fisheye or bool(np.any(self.distortion))


@dataclass(frozen=True)
class Calibration:
    """Intrinsics of one or two cameras, and their relative pose."""

    left: Intrinsics
    right: Intrinsics | None = None
    rotation: NDArray[np.float64] | None = None
    """(3, 3) R of x_right = R x_left + t."""
    translation_mm: NDArray[np.float64] | None = None
    """(3,) t, mm: about (-baseline, 0, 0)."""
    size: tuple[int, int] | None = None
    """(width, height) of one camera's image during calibration, px; None if the file does not state it."""
    layout: str | None = None
    """Text in the file that describes the stereo layout."""
    size_is_sure: bool = False
    """The user states the size, or this program wrote it: a principal point far from the center is a crop."""
    notes: tuple[str, ...] = ()
    """What the reader decided, one line each."""

    @property
    def rectified(self) -> bool:
        """Whether the images are rectified already, and by one camera matrix: disparity 0 is infinitely far."""
        if self.right is None or self.rotation is None or self.translation_mm is None:
            return False
        rotated = np.abs(self.rotation - np.eye(3)).max() > NEGLIGIBLE
        shifted = np.abs(self.translation_mm[1:]).max() > NEGLIGIBLE
        bent = self.left.bent or self.right.bent
        return bool(not (bent or rotated or shifted) and np.allclose(self.left.matrix, self.right.matrix))


def check_pair(calibration: Calibration, name: str) -> float:
    """Baseline of a stereo calibration, mm.

    Raises:
        InputError: one camera only, left and right swapped, cameras not side by side, or an implausible baseline.
    """
    if calibration.right is None or calibration.rotation is None or calibration.translation_mm is None:
        raise input_error(name, "both cameras, R and T", "one camera", "Pass a stereo calibration, or `--layout mono`.")
    x, y, z = calibration.translation_mm
    if abs(x) < max(abs(y), abs(z)):
        hint = "The cameras must be side by side: rotate images and calibration by 90 degrees."
        raise input_error(name, "T along x", f"({x:g}, {y:g}, {z:g}) mm", hint)
    if x > 0:
        hint = "Swap left and right in the file, or write R and T that map left to right camera coordinates."
        raise input_error(name, "T[0] < 0 (x_right = R x_left + T)", f"{x:g} mm: left and right are swapped", hint)
    baseline = float(np.linalg.norm(calibration.translation_mm))
    if not MIN_BASELINE_MM <= baseline <= MAX_BASELINE_MM:
        hint = "Set the unit of T with --calibration-unit."
        raise input_error(
            name, f"a baseline of {MIN_BASELINE_MM:g} to {MAX_BASELINE_MM:g} mm", f"{baseline:g} mm", hint
        )
    return baseline
