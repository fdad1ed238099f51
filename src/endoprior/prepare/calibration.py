"""Calibration of one or two cameras, and for images of which size it was made: a wrong answer scales every length.

Matrices follow OpenCV (x right, y down, z forward) with one exception: the center of the top-left pixel is (0.5, 0.5)
here and (0, 0) in OpenCV. Principal points from OpenCV files are therefore moved by half a pixel. A file that states no
size is used as it is only if its principal point is that of the video; otherwise the user is asked.
"""

from __future__ import annotations

import re
from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from ..core.checks import InputError, input_error

MIN_BASELINE_MM, MAX_BASELINE_MM = 1.0, 30.0  # the baseline of stereo endoscopes is 3 to 6 mm; bench setups reach 30 mm
NEGLIGIBLE = 1e-6  # rotation, or vertical offset in mm, below which a pair without distortion counts as rectified
CENTERED = 0.1  # mean principal points are off the image center by less than this share of half the image ...
FAR_OFF = 0.5  # ... and if further off than this, the images were cropped or have another size
SAME_ASPECT = 0.01
SQUEEZED = 0.12  # a factor from 2 that counts as 2, as a share: an image at half its width or height
USUAL_RATIOS = (1 / 4, 1 / 3, 1 / 2, 2 / 3, 3 / 4, 4 / 3, 3 / 2, 2, 3, 4)
NEAR_RATIO = 0.06  # an estimated ratio this near to a usual one is that one, as a share
Size = tuple[int, int]  # (width, height) of one camera's image, px


@dataclass(frozen=True)
class Intrinsics:
    """Camera matrix and lens distortion of one camera."""

    matrix: NDArray  # (3, 3) K, px
    distortion: NDArray  # (k,) OpenCV distortion coefficients, k in 0, 4, 5, 8, 12, 14; of a fisheye k1..k4
    fisheye: bool = False  # OpenCV's model (equidistant, Kannala-Brandt): bent even where all coefficients are 0

    @property
    def bent(self) -> bool:
        """Whether straight lines become curves."""
        return self.fisheye or bool(np.any(self.distortion))


@dataclass(frozen=True)
class Calibration:
    """Intrinsics of one or two cameras, and their relative pose."""

    left: Intrinsics
    right: Intrinsics | None = None
    rotation: NDArray | None = None  # (3, 3) R of x_right = R x_left + t
    translation_mm: NDArray | None = None  # (3,) t, mm: about (-baseline, 0, 0)
    size: Size | None = None  # of the images that it was made for; None if the file does not state it
    layout: str | None = None  # text in the file that describes the stereo layout
    size_is_sure: bool = False  # stated by the user, or by this program: a principal point far off means a crop
    notes: tuple[str, ...] = ()  # what the reader decided, one line each

    @property
    def cameras(self) -> list[Intrinsics]:
        """The left one, and the right one if there is one."""
        return [self.left, *([self.right] if self.right else [])]

    @property
    def rectified(self) -> bool:
        """Whether the images are rectified already, and by one camera matrix: disparity 0 is infinitely far."""
        if self.right is None or self.rotation is None or self.translation_mm is None:
            return False
        apart = max(np.abs(self.rotation - np.eye(3)).max(), np.abs(self.translation_mm[1:]).max())
        bent = self.left.bent or self.right.bent
        return bool(not bent and apart <= NEGLIGIBLE and np.allclose(self.left.matrix, self.right.matrix))

    def scaled(self, across: float, down: float, size: Size | None) -> Calibration:
        """For images that are resized by these factors, to this size."""
        grow = np.diag([across, down, 1.0])
        left, *right = (replace(camera, matrix=grow @ camera.matrix) for camera in self.cameras)
        return replace(self, left=left, right=right[0] if right else None, size=size)


def check_pair(calibration: Calibration, name: str) -> float:
    """Baseline of a stereo calibration, mm.

    Raises:
        InputError: one camera only, left and right swapped, cameras not side by side, or an implausible baseline.
    """
    if calibration.right is None or calibration.translation_mm is None:
        raise input_error(name, "both cameras, R and T", "one camera", "Pass a stereo calibration, or `--layout mono`.")
    x, y, z = calibration.translation_mm
    if abs(x) < max(abs(y), abs(z)):
        fix = "The cameras must be side by side: rotate images and calibration by 90 degrees."
        raise input_error(name, "T along x", f"({x:g}, {y:g}, {z:g}) mm", fix)
    if x > 0:
        fix = "Swap left and right in the file, or write R and T that map left to right camera coordinates."
        raise input_error(name, "T[0] < 0 (x_right = R x_left + T)", f"{x:g} mm: left and right are swapped", fix)
    baseline = float(np.linalg.norm(calibration.translation_mm))
    if not MIN_BASELINE_MM <= baseline <= MAX_BASELINE_MM:
        want = f"a baseline of {MIN_BASELINE_MM:g} to {MAX_BASELINE_MM:g} mm"
        raise input_error(name, want, f"{baseline:g} mm", "Set the unit of T with --calibration-unit.")
    return baseline


def parse_size(text: str) -> Size:
    """`1280x1024`; raises InputError for another form."""
    if found := re.fullmatch(r"([1-9][0-9]{0,5})[x,]([1-9][0-9]{0,5})", text.strip()):
        return int(found[1]), int(found[2])
    raise input_error("--calibration-size", "WIDTHxHEIGHT in px", repr(text), "`--calibration-size 1280x1024`.")


def written_in_order(size: Size, cameras: Sequence[Intrinsics]) -> Size:
    """A stated pair as (width, height): NumPy's shapes are (height, width), and the principal point tells."""
    if not cameras or not all((camera.matrix[:2, 2] > 0).all() for camera in cameras):
        return size
    other = size[1], size[0]
    as_stated, turned = (np.abs(np.log(_ratios(cameras, pair))).sum() for pair in (size, other))
    return other if turned < as_stated / 2 else size


def fitted(calibration: Calibration, size: Size, name: str, *, squeezed: bool) -> tuple[Calibration, list[str]]:
    """The calibration in px of images of this size, and notes on what was decided.

    Args:
        size: of one camera's image, stretched if it was squeezed.
        name: of the calibration file, for messages.
        squeezed: whether the user says that images are squeezed.
    Raises:
        InputError: its images had another shape, or the size of its images is unknown and not clear.
    """
    shown, stated = f"{size[0]}x{size[1]}", calibration.size
    if stated is None:
        across, down = _ratios(calibration.cameras, size)
        if max(abs(across - 1), abs(down - 1)) > CENTERED:
            raise _unknown_size(calibration, (across, down), size, name)
        note = (
            f"{name} states no image size; {shown} px are taken, because its principal point fits. If its images had "
            f"another size: --calibration-size WIDTHxHEIGHT"
        )
        return replace(calibration, size=size), [note]
    was, across, down = "{}x{}".format(*stated), size[0] / stated[0], size[1] / stated[1]
    if abs(across / down - 1) > SAME_ASPECT:
        fix = "Pass the calibration of this video, or set --layout."
        if not squeezed and _is_squeezed(down / across):
            fix = "`--squeezed-eyes` if both cameras share a frame at half their width or height; else set --layout."
        elif squeezed and _is_squeezed(across / down):
            fix = "Remove --squeezed-eyes."
        raise input_error(name, f"images of {was} px, or the same aspect ratio", shown, fix)
    if np.abs(_ratios(calibration.cameras, stated) - 1).max() > FAR_OFF and not calibration.size_is_sure:
        x, y = calibration.left.matrix[:2, 2] - 0.5
        fix = "Correct the size in the file, or state it: `--calibration-size WIDTHxHEIGHT`."
        raise input_error(name, f"a principal point near the center of its {was} px", f"({x:g}, {y:g})", fix)
    if stated == size:
        return calibration, []
    return calibration.scaled(across, down, size), [f"the calibration is scaled from {was} to {shown} px"]


def _ratios(cameras: Sequence[Intrinsics], size: Size) -> NDArray:
    """(2,) twice the mean principal point, in image widths and heights: 1 at the center."""
    return 2 * np.mean([camera.matrix[:2, 2] for camera in cameras], 0) / size


def _unknown_size(calibration: Calibration, ratios: tuple[float, float], size: Size, name: str) -> InputError:
    """The error that asks for the size, with the likely answer."""
    (across, down), (x, y) = ratios, calibration.left.matrix[:2, 2] - 0.5
    fix = "`--calibration-size WIDTHxHEIGHT` with the size of its images; if they were cropped, crop the same part."
    if min(across, down) > 0 and abs(across / down - 1) < CENTERED:
        ratio = (across + down) / 2
        usual = min(USUAL_RATIOS, key=lambda each: abs(np.log(each / ratio)))
        ratio = usual if abs(usual / ratio - 1) < NEAR_RATIO else ratio
        fix = f"`--calibration-size {round(size[0] * ratio)}x{round(size[1] * ratio)}` if its images had that size."
    elif min(across, down) > 0 and _is_squeezed(across / down):
        fix = "`--squeezed-eyes` if both cameras share a frame at half their width or height."
    want = f"the size of its images, or a principal point near the center of {size[0]}x{size[1]} px"
    return input_error(name, want, f"no size, and ({x:g}, {y:g})", fix)


def _is_squeezed(aspect: float) -> bool:
    return abs(aspect / 2 - 1) < SQUEEZED or abs(aspect * 2 - 1) < SQUEEZED
