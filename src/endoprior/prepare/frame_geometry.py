"""From a source image to a frame: stretch, rectify or undistort, crop, resize. All frames share one camera matrix.

Rectangles and borders are in px of one camera's source image.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace

import cv2
import numpy as np
from numpy.typing import NDArray

from ..core.checks import input_error
from ..footage.border import Circle, Strips
from .calibration import Calibration, check_pair
from .config import Rectangle
from .rectification import Maps, Rectified, identity, rectify, stretched

MIN_SIDE_PX = 32


@dataclass(frozen=True)
class FrameGeometry:
    """How every source image becomes a frame."""

    source_size: tuple[int, int]
    """(width, height) of one camera's source image, px."""
    maps: tuple[Maps | None, Maps | None]
    """Where each pixel of the rectified left and right image lies in the source; None if the images are rectified."""
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
    stretch: tuple[int, int] = (1, 1),
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
        calibration: in px of this image, stretched; None assumes a pinhole camera of `field_of_view_degrees` with a
            centered principal point.
        name: of the calibration, for error messages.
        stretch: factors (across, down) that undo the squeezing of an image.
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
    baseline = None
    painted = np.zeros_like(keep)
    for x, y, w, h in blank:
        painted[y : y + h, x : x + w] = True
    full = width * stretch[0], height * stretch[1]
    if calibration is None:
        # A round border of a squeezed image is no circle.
        assumed = _assumed(*full, circle if full == size else None, field_of_view_degrees)
        rectified = Rectified(assumed, np.eye(3), (None, None))
    else:
        baseline = check_pair(calibration, name) if stereo else None
        rectified = rectify(calibration, full, name, stereo=stereo)
    maps = stretched(rectified.maps[0], full, stretch), stretched(rectified.maps[1], full, stretch)
    warped = keep if maps[0] is None else cv2.remap(keep.astype(np.uint8), *maps[0], cv2.INTER_NEAREST) > 0
    cut = _bounding_box(warped)
    frame = _frame_size(cut, max_width)
    scale = np.diag([frame[0] / cut[2], frame[1] / cut[3], 1.0])
    shift = np.array([[1, 0, -cut[0]], [0, 1, -cut[1]], [0, 0, 1.0]])
    shown = keep & ~painted
    shown = shown if maps[0] is None else cv2.remap(shown.astype(np.uint8), *maps[0], cv2.INTER_NEAREST) > 0
    inside = _shrink(_cut(shown.astype(np.float32), cut), frame) > 0.999
    matrix = scale @ shift @ rectified.matrix
    return FrameGeometry(size, maps, cut, frame, matrix, rectified.turn, baseline, painted, inside)


def with_rows_moved(geometry: FrameGeometry, offset_px: float) -> FrameGeometry:
    """The geometry whose right frames are moved up by a row offset, px of a frame, so that the rows of a pair agree.

    Args:
        offset_px: y_right - y_left of the same points.
    """
    offset = np.float32(offset_px * geometry.cut[3] / geometry.size[1])
    columns, rows = identity(geometry.source_size if geometry.maps[1] is None else geometry.maps[1][0].shape[::-1])
    maps = columns, rows + offset
    if geometry.maps[1] is not None:  # maps are smooth: those of the rows below, 0 beyond the image
        maps = tuple(
            cv2.remap(of, *maps, cv2.INTER_LINEAR, borderMode=cv2.BORDER_CONSTANT, borderValue=-1e4)
            for of in geometry.maps[1]
        )
    return replace(geometry, maps=(geometry.maps[0], maps))


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
