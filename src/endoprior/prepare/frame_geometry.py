"""From a source image to a frame: rectify or undistort, crop, resize. All frames share one camera matrix.

Rectangles and borders are in px of one camera's source image.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass

import cv2
import numpy as np
from numpy.typing import NDArray

from ..core.checks import input_error
from ..footage.border import Circle, Strips
from .calibration import Calibration, check_pair
from .config import Rectangle

MIN_SIDE_PX = 32
Maps = tuple[NDArray[np.float32], NDArray[np.float32]]


@dataclass(frozen=True)
class FrameGeometry:
    """How every source image becomes a frame."""

    source_size: tuple[int, int]
    """(width, height) of one camera's source image, px."""
    maps: tuple[Maps | None, Maps | None]
    """Rectification maps of the left and right camera; None if the images are rectified already."""
    cut: Rectangle
    """Part of the rectified image to keep."""
    size: tuple[int, int]
    """(width, height) of a frame, px."""
    matrix: NDArray[np.float64]
    """(3, 3) camera matrix K of the frames, px; the left-most pixel is centered at 0.5."""
    turn: NDArray[np.float64]
    """(3, 3) rotation from the axes of the source's left camera to those of the frames."""
    baseline_mm: float | None
    """None if monocular."""
    blank: NDArray[np.bool_]
    """(h, w) of the source: True where images are painted black."""
    inside: NDArray[np.bool_]
    """(H, W) of a frame: True inside the endoscope's field of view."""

    def image(self, rgb_u8: NDArray[np.uint8], right: bool = False) -> NDArray[np.uint8]:
        """The frame (H, W, 3) of a source image (h, w, 3)."""
        if self.blank.any():
            rgb_u8 = np.where(self.blank[..., None], np.uint8(0), rgb_u8)
        maps = self.maps[int(right)]
        if maps is not None:
            rgb_u8 = cv2.remap(rgb_u8, *maps, cv2.INTER_CUBIC)
        return _shrink(_cut(rgb_u8, self.cut), self.size)

    def values(self, image: NDArray) -> NDArray:
        """A mask or depth map of the left source image (h, w), resampled to the frame (H, W) by nearest neighbor.

        An array of the frame's size is returned as it is, unless the source has that size, too.
        """
        if image.shape[:2] != self.source_size[::-1]:
            return image
        maps = self.maps[0]
        stored = image.astype(np.uint8) if image.dtype == bool else image
        if maps is not None:
            stored = cv2.remap(stored, *maps, cv2.INTER_NEAREST)
        stored = cv2.resize(_cut(stored, self.cut), self.size, interpolation=cv2.INTER_NEAREST)
        return stored.astype(image.dtype)


def _cut(image: NDArray, cut: Rectangle) -> NDArray:
    x, y, width, height = cut
    return np.ascontiguousarray(image[y : y + height, x : x + width])


def _shrink(image: NDArray, size: tuple[int, int]) -> NDArray:
    return image if image.shape[1::-1] == size else cv2.resize(image, size, interpolation=cv2.INTER_AREA)


def make_geometry(
    size: tuple[int, int],
    calibration: Calibration | None,
    *,
    stereo: bool,
    name: str,
    field_of_view_degrees: float,
    max_width: int,
    crop: Rectangle | None = None,
    blank: Sequence[Rectangle] = (),
    strips: Strips | None = None,
    circle: Circle | None = None,
    outside: NDArray[np.bool_] | None = None,
) -> FrameGeometry:
    """Compute the geometry of all frames.

    Args:
        size: (width, height) of one camera's source image.
        calibration: None assumes a pinhole camera of `field_of_view_degrees` with a centered principal point.
        name: of the calibration, for error messages.
        crop, blank, strips, circle: parts to keep and parts to paint over. The rim of the circle is left out.
        outside: (h, w) of the source, True on more that shows no tissue, such as black arcs inside of the circle.
    Raises:
        InputError: the crop leaves too little, or the calibration does not fit.
    """
    width, height = size
    keep = np.ones((height, width), bool)
    if crop is not None:
        demand_within(crop, size, "--crop")
        x, y, w, h = crop
        keep[:] = False
        keep[y : y + h, x : x + w] = True
    if strips:
        keep[: strips.top] = keep[height - strips.bottom :] = False
        keep[:, : strips.left] = keep[:, width - strips.right :] = False
    if circle:
        keep &= circle.mask(width, height, circle.margin_px)
    if outside is not None:
        keep &= ~outside
    painted = np.zeros_like(keep)
    for x, y, w, h in blank:
        painted[y : y + h, x : x + w] = True
    maps: tuple[Maps | None, Maps | None] = (None, None)
    baseline, turn = None, np.eye(3)
    if calibration is None:
        matrix = _assumed(width, height, circle, field_of_view_degrees)
    else:
        calibration = calibration.for_size(width, height, name)
        if stereo:
            baseline = check_pair(calibration, name)
            matrix, turn, maps = _rectify_pair(calibration, size)
        else:
            matrix, maps = _undistort(calibration, size)
    warped = keep if maps[0] is None else cv2.remap(keep.astype(np.uint8), *maps[0], cv2.INTER_NEAREST) > 0
    cut = _bounding_box(warped)
    frame = _frame_size(cut, max_width)
    scale = np.diag([frame[0] / cut[2], frame[1] / cut[3], 1.0])
    shift = np.array([[1, 0, -cut[0]], [0, 1, -cut[1]], [0, 0, 1.0]])
    shown = keep & ~painted
    shown = shown if maps[0] is None else cv2.remap(shown.astype(np.uint8), *maps[0], cv2.INTER_NEAREST) > 0
    inside = _shrink(_cut(shown.astype(np.float32), cut), frame) > 0.999
    return FrameGeometry(size, maps, cut, frame, scale @ shift @ matrix, turn, baseline, painted, inside)


def demand_within(rectangle: Rectangle, size: tuple[int, int], option: str) -> None:
    """Raise InputError unless a rectangle lies within an image of this (width, height), px."""
    x, y, width, height = rectangle
    if x + width > size[0] or y + height > size[1]:
        want, hint = f"a rectangle within {size[0]}x{size[1]} px", "Choose a rectangle inside one camera's image."
        raise input_error(option, want, ",".join(map(str, rectangle)), hint)


def _assumed(width: int, height: int, circle: Circle | None, degrees: float) -> NDArray[np.float64]:
    """K of a camera with an assumed field of view."""
    half = math.tan(math.radians(degrees / 2))
    extent, x, y = (width / 2, width / 2, height / 2)
    if circle is not None:
        extent, x, y = circle.radius, circle.center_x, circle.center_y
    return np.array([[extent / half, 0, x], [0, extent / half, y], [0, 0, 1.0]])


def _moved(matrix: NDArray, by: float) -> NDArray[np.float64]:
    """K with its principal point moved: OpenCV counts pixel centers from 0, this package from 0.5."""
    moved = matrix.copy()
    moved[:2, 2] += by
    return moved


def _rectify_pair(
    calibration: Calibration, size: tuple[int, int]
) -> tuple[NDArray, NDArray, tuple[Maps | None, Maps | None]]:
    """K of both rectified cameras, the left one's turn, and the maps; None if the images are rectified already."""
    left, right = calibration.left, calibration.right
    assert right is not None and calibration.rotation is not None and calibration.translation_mm is not None
    if calibration.rectified:
        return left.matrix, np.eye(3), (None, None)
    k1, k2 = _moved(left.matrix, -0.5), _moved(right.matrix, -0.5)
    r1, r2, p1, p2 = cv2.stereoRectify(
        k1, left.distortion, k2, right.distortion, size, calibration.rotation,
        calibration.translation_mm.reshape(3, 1), flags=cv2.CALIB_ZERO_DISPARITY, alpha=0,
    )[:4]  # fmt: skip
    maps = (
        cv2.initUndistortRectifyMap(k1, left.distortion, r1, p1, size, cv2.CV_32FC1),
        cv2.initUndistortRectifyMap(k2, right.distortion, r2, p2, size, cv2.CV_32FC1),
    )
    return _moved(p1[:, :3], 0.5), r1, maps


def _undistort(calibration: Calibration, size: tuple[int, int]) -> tuple[NDArray, tuple[Maps | None, None]]:
    camera = calibration.left
    if not np.any(camera.distortion):
        return camera.matrix, (None, None)
    k = _moved(camera.matrix, -0.5)
    better, _ = cv2.getOptimalNewCameraMatrix(k, camera.distortion, size, 0)
    return _moved(better, 0.5), (
        cv2.initUndistortRectifyMap(k, camera.distortion, None, better, size, cv2.CV_32FC1),
        None,
    )


def _bounding_box(keep: NDArray[np.bool_]) -> Rectangle:
    rows, columns = np.flatnonzero(keep.any(1)), np.flatnonzero(keep.any(0))
    if len(rows) < MIN_SIDE_PX or len(columns) < MIN_SIDE_PX:
        hint = "Use a larger --crop, or `--border keep`."
        raise input_error("--crop", f"at least {MIN_SIDE_PX} px a side", f"{len(columns)}x{len(rows)}", hint)
    return int(columns[0]), int(rows[0]), int(columns[-1] - columns[0] + 1), int(rows[-1] - rows[0] + 1)


def _frame_size(cut: Rectangle, max_width: int) -> tuple[int, int]:
    width, height = cut[2], cut[3]
    if max_width and width > max_width:
        return max_width, max(round(height * max_width / width), 1)
    return width, height
