"""From a source image to a frame: stretch, rectify or undistort, crop, resize. All frames share one camera matrix.

Rectangles and borders are in px of one camera's source image. A map has, for each pixel of the rectified image, the
column and the row of the source image, px counted from 0.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace

import cv2
import numpy as np
from numpy.typing import NDArray

from ..core.checks import input_error
from ..core.ranges import evenly_spaced
from ..footage.border import Strips
from ..footage.round_border import Circle
from ..footage.stereo_matching import row_offsets_px
from .calibration import Calibration, Intrinsics, Size, check_pair
from .config import Rectangle

MIN_SIDE_PX = 32
MIN_FOCAL_SHARE, MAX_FOCAL_SHARE = 0.2, 5.0  # wrong coefficients give a focal length outside of these shares
MAX_LOST = 0.2  # so much of an image may be lost: corners outside of a round image, where nothing was measured
COMPARED = 8  # number of frames in which the offset between the rows of both cameras is measured ...
MIN_FEATURES = 40  # ... and of matching features, over all of them, that it needs
Maps = tuple[NDArray, NDArray]
Pair = tuple[Maps | None, Maps | None]
Mask = NDArray[np.bool_]


@dataclass(frozen=True)
class FrameGeometry:
    """How every source image becomes a frame."""

    source_size: Size  # (width, height) of one camera's source image, px
    maps: Pair  # where the pixels of the rectified images lie in the source; None if these are rectified
    cut: Rectangle  # part of the rectified image to keep
    size: Size  # (width, height) of a frame, px
    matrix: NDArray  # (3, 3) camera matrix K of the frames, px; the left-most pixel is centered at 0.5
    turn: NDArray  # (3, 3) rotation from the axes of the source's left camera to those of the frames
    baseline_mm: float | None  # None if monocular
    blank: Mask  # (h, w) of the source: True where images are painted black
    view: Mask  # (h, w) of the source: True on what frames keep and is not masked in all of them
    inside: Mask  # (H, W) of a frame: True inside the endoscope's field of view

    def image(self, rgb_u8: NDArray, right: bool = False) -> NDArray:
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
        stored = image.astype(np.uint8) if image.dtype == bool else image
        if self.maps[0] is not None:
            stored = cv2.remap(stored, *self.maps[0], cv2.INTER_NEAREST)
        stored = cv2.resize(_cut(stored, self.cut), self.size, interpolation=cv2.INTER_NEAREST)
        return stored.astype(image.dtype)


def make_geometry(
    size: Size, calibration: Calibration | None, *, stereo: bool, name: str, stretch: Size = (1, 1),
    field_of_view_degrees: float, max_width: int, crop: Rectangle | None = None, blank: Sequence[Rectangle] = (),
    strips: Strips | None = None, circle: Circle | None = None, outside: Mask | None = None,
) -> FrameGeometry:  # fmt: skip
    """Compute the geometry of all frames.

    Args:
        size: (width, height) of one camera's source image.
        calibration: in px of this image, stretched; None assumes a pinhole camera of `field_of_view_degrees` with a
            centered principal point.
        name: of the calibration, for error messages.
        stretch: factors (across, down) that undo the squeezing of an image.
        crop, blank, strips, circle: parts to keep and parts to paint over. The rim of the circle is left out.
        outside: (h, w) of the source, True on what else is beyond the border, of any shape. Without a circle, the field
            of view spans the rest.
    Raises:
        InputError: the crop leaves too little, or the calibration does not fit.
    """
    full, painted = (size[0] * stretch[0], size[1] * stretch[1]), np.zeros(size[::-1], bool)
    for x, y, w, h in blank:
        painted[y : y + h, x : x + w] = True
    keep = _kept(size, crop, strips, circle)
    if outside is not None:
        keep &= ~outside
    baseline, turn = None, np.eye(3)
    maps: Pair = None, None
    if calibration is None:
        # A round border of a squeezed image is no circle.
        seen = _bounding_box(~outside) if full == size and outside is not None and outside.any() else (0, 0, *full)
        matrix = _assumed(seen, circle if full == size else None, field_of_view_degrees)
    else:
        baseline = check_pair(calibration, name) if stereo else None
        matrix, turn, maps = rectify(calibration, full, name, stereo=stereo)
    maps = _stretched(maps[0], full, stretch), _stretched(maps[1], full, stretch)

    def warped(mask: Mask) -> Mask:
        return mask if maps[0] is None else cv2.remap(mask.astype(np.uint8), *maps[0], cv2.INTER_NEAREST) > 0

    cut = _bounding_box(warped(keep))
    frame = cut[2:]
    if max_width and frame[0] > max_width:
        frame = max_width, max(round(cut[3] * max_width / cut[2]), 1)
    inside = _shrink(_cut(warped(keep & ~painted).astype(np.float32), cut), frame) > 0.999
    scale = np.diag([frame[0] / cut[2], frame[1] / cut[3], 1.0])
    shift = np.array([[1, 0, -cut[0]], [0, 1, -cut[1]], [0, 0, 1.0]])
    return FrameGeometry(
        size, maps, cut, frame, scale @ shift @ matrix, turn, baseline, painted, keep & ~painted, inside
    )


def _kept(size: Size, crop: Rectangle | None, strips: Strips | None, circle: Circle | None) -> Mask:
    """(h, w) True on the part of the source to keep."""
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
    return keep & circle.mask(width, height, circle.margin_px) if circle else keep


def demand_within(rectangle: Rectangle, size: Size, option: str) -> None:
    """Raise InputError unless a rectangle lies within an image of this (width, height), px."""
    x, y, width, height = rectangle
    if x + width > size[0] or y + height > size[1]:
        want, hint = f"a rectangle within {size[0]}x{size[1]} px", "Choose a rectangle inside one camera's image."
        raise input_error(option, want, ",".join(map(str, rectangle)), hint)


def _cut(image: NDArray, cut: Rectangle) -> NDArray:
    x, y, width, height = cut
    return np.ascontiguousarray(image[y : y + height, x : x + width])


def _shrink(image: NDArray, size: Size) -> NDArray:
    return image if image.shape[1::-1] == size else cv2.resize(image, size, interpolation=cv2.INTER_AREA)


def _assumed(seen: Rectangle, circle: Circle | None, degrees: float) -> NDArray:
    """K of a camera with an assumed field of view, across a circle or the part that is seen."""
    left, top, width, height = seen
    extent, x, y = width / 2, left + width / 2, top + height / 2
    if circle is not None:
        extent, x, y = circle.radius, circle.center_x, circle.center_y
    focal = extent / math.tan(math.radians(degrees / 2))
    return np.array([[focal, 0, x], [0, focal, y], [0, 0, 1.0]])


def _bounding_box(keep: Mask) -> Rectangle:
    rows, columns = np.flatnonzero(keep.any(1)), np.flatnonzero(keep.any(0))
    if len(rows) < MIN_SIDE_PX or len(columns) < MIN_SIDE_PX:
        hint = "Use a larger --crop, or `--border keep`."
        raise input_error("--crop", f"at least {MIN_SIDE_PX} px a side", f"{len(columns)}x{len(rows)}", hint)
    return int(columns[0]), int(rows[0]), int(columns[-1] - columns[0] + 1), int(rows[-1] - rows[0] + 1)


def rectify(calibration: Calibration, size: Size, name: str, *, stereo: bool) -> tuple[NDArray, NDArray, Pair]:
    """Rectify images of this (width, height), px, so that every pixel of the result shows something.

    Args:
        calibration: in px of these images; with both cameras if `stereo`.
        name: of its file, for error messages.
    Returns:
        (3, 3) K of both rectified cameras; (3, 3) rotation from the axes of the left camera to those of the rectified
        one; and the maps.
    Raises:
        InputError: the distortion cannot be undone, or only one lens is a fisheye.
    """
    matrix, turn, maps = _pair(calibration, size, name) if stereo else _single(calibration.left, size)
    share = matrix[0, 0] / calibration.left.matrix[0, 0]
    lost = max((_lost(each, size) for each in maps if each is not None), default=0.0)
    if lost > MAX_LOST or not MIN_FOCAL_SHARE < share < MAX_FOCAL_SHARE:
        got = f"{share:.3g} times the focal length and {lost:.0%} of the image lost after it"
        fix = "Check the distortion, its model and the size of its images."
        raise input_error(name, "a distortion that can be undone", got, fix)
    return matrix, turn, maps


def _single(camera: Intrinsics, size: Size) -> tuple[NDArray, NDArray, Pair]:
    if not camera.bent:
        return camera.matrix, np.eye(3), (None, None)
    k, bent = _moved(camera.matrix, -0.5), camera.distortion
    if camera.fisheye:
        better = cv2.fisheye.estimateNewCameraMatrixForUndistortRectify(k, bent, size, np.eye(3), balance=0)
    else:
        better = cv2.getOptimalNewCameraMatrix(k, bent, size, 0)[0]
    return _moved(better, 0.5), np.eye(3), (_maps(camera, np.eye(3), better, size), None)


def _pair(calibration: Calibration, size: Size, name: str) -> tuple[NDArray, NDArray, Pair]:
    left, right = calibration.left, calibration.right
    assert right is not None and calibration.rotation is not None and calibration.translation_mm is not None
    if calibration.rectified:
        return left.matrix, np.eye(3), (None, None)
    if left.fisheye != right.fisheye:
        fix = "Name the model of both lenses."
        raise input_error(name, "two lenses of one model", "one fisheye and one that is not", fix)
    both = (
        _moved(left.matrix, -0.5), left.distortion, _moved(right.matrix, -0.5), right.distortion, size,
        calibration.rotation, calibration.translation_mm.reshape(3, 1),
    )  # fmt: skip
    if left.fisheye:
        r1, r2, p1, p2 = cv2.fisheye.stereoRectify(*both, flags=cv2.CALIB_ZERO_DISPARITY, balance=0)[:4]
    else:
        r1, r2, p1, p2 = cv2.stereoRectify(*both, flags=cv2.CALIB_ZERO_DISPARITY, alpha=0)[:4]
    maps = _maps(left, r1, p1[:, :3], size), _maps(right, r2, p2[:, :3], size)
    return _moved(p1[:, :3], 0.5), r1, maps


def _moved(matrix: NDArray, by: float) -> NDArray:
    """K with its principal point moved: OpenCV counts pixel centers from 0, this package from 0.5."""
    moved = matrix.copy()
    moved[:2, 2] += by
    return moved


def _maps(camera: Intrinsics, turn: NDArray, matrix: NDArray, size: Size) -> Maps:
    """Args: matrix: K of the rectified camera, px counted from 0."""
    make = cv2.fisheye.initUndistortRectifyMap if camera.fisheye else cv2.initUndistortRectifyMap
    return make(_moved(camera.matrix, -0.5), camera.distortion, turn, matrix, size, cv2.CV_32FC1)


def _lost(maps: Maps, size: Size) -> float:
    """Share of the rectified pixels that are outside of the source image, or whose neighbors change sides in it."""
    (x_down, x_across), (y_down, y_across) = (np.gradient(of) for of in maps)
    shown = (maps[0] > -1) & (maps[0] < size[0]) & (maps[1] > -1) & (maps[1] < size[1])
    return float((~shown | (x_across * y_down - x_down * y_across <= 0)).mean())


def _identity(size: Size) -> Maps:
    columns, rows = np.meshgrid(*(np.arange(side, dtype=np.float32) for side in size))
    return columns, rows


def _stretched(maps: Maps | None, size: Size, stretch: Size) -> Maps | None:
    """Maps into an image squeezed to 1 / stretch (across, down), from those into the image of this size."""
    if stretch == (1, 1):
        return maps
    half = np.float32(0.5)
    columns, rows = _identity(size) if maps is None else maps
    return (columns + half) / stretch[0] - half, (rows + half) / stretch[1] - half


def with_rows_moved(geometry: FrameGeometry, offset_px: float) -> FrameGeometry:
    """The geometry whose right frames are moved up by a row offset y_right - y_left, px of a frame."""
    old = geometry.maps[1]
    offset = np.float32(offset_px * geometry.cut[3] / geometry.size[1])
    columns, rows = _identity(geometry.source_size if old is None else old[0].shape[::-1])
    maps = columns, rows + offset
    if old is not None:  # maps are smooth: those of the rows below, 0 beyond the image
        of, how = maps, {"interpolation": cv2.INTER_LINEAR, "borderMode": cv2.BORDER_CONSTANT, "borderValue": -1e4}
        maps = cv2.remap(old[0], *of, **how), cv2.remap(old[1], *of, **how)
    return replace(geometry, maps=(geometry.maps[0], maps))


def with_equal_rows(
    geometry: FrameGeometry, pairs: Sequence[tuple[NDArray, NDArray | None]]
) -> tuple[FrameGeometry, str]:
    """The geometry that moves the right images so that the rows of both cameras agree, and a note.

    The offset is the median over features of all frames: one number, because it comes from the mounting of the cameras.

    Args:
        pairs: left and right source images (h, w, 3).
    Raises:
        InputError: one camera, or too few features match.
    """
    fix, both = "Remove `--row-offset auto`.", [(left, right) for left, right in pairs if right is not None]
    if len(both) < len(pairs):
        raise input_error("--row-offset", "two cameras", "one camera", fix)
    both = [both[i] for i in evenly_spaced(len(both), COMPARED)]

    def offsets(of: FrameGeometry) -> NDArray:
        return np.concatenate([row_offsets_px(of.image(left), of.image(right, right=True)) for left, right in both])

    before = offsets(geometry)
    if len(before) < MIN_FEATURES:
        raise input_error("--row-offset", f"{MIN_FEATURES} features that both cameras see", str(len(before)), fix)
    offset = float(np.median(before))
    moved = with_rows_moved(geometry, offset)
    left = float(np.median(np.abs(offsets(moved))))
    words = f"the right images are moved {'up' if offset > 0 else 'down'} by {abs(offset):.2f} px"
    return moved, f"{words}: the rows of both cameras were {np.median(np.abs(before)):.2f} px apart, now {left:.2f}"
