"""Rectify a pair of cameras, or undistort one: camera matrix, rotation, and the maps that resample images.

A map has, for each pixel of the rectified image, the column and the row of the source image, px counted from 0.
"""

from __future__ import annotations

from dataclasses import dataclass

import cv2
import numpy as np
from numpy.typing import NDArray

from ..core.checks import input_error
from .calibration import Calibration, Intrinsics

Maps = tuple[NDArray[np.float32], NDArray[np.float32]]
LEAST_FOCAL_SHARE, MOST_FOCAL_SHARE = 0.2, 5.0
"""A rectified focal length outside of this range, as a share of the calibrated one, comes from wrong coefficients."""
MOST_LOST = 0.2
"""So much of an image may be lost: corners outside of a round image, where nothing was measured."""


@dataclass(frozen=True)
class Rectified:
    """What rectification changes."""

    matrix: NDArray[np.float64]
    """(3, 3) K of the rectified left camera, and of the right one; the left-most pixel is centered at 0.5."""
    turn: NDArray[np.float64]
    """(3, 3) rotation from the axes of the left camera to those of the rectified one."""
    maps: tuple[Maps | None, Maps | None]
    """Of the left and the right image; None where it stays as it is."""


def rectify(calibration: Calibration, size: tuple[int, int], name: str, *, stereo: bool) -> Rectified:
    """Rectify images of this (width, height), px. Every pixel of the result shows something.

    Args:
        calibration: in px of these images; with both cameras if `stereo`.
        name: of its file, for error messages.
    Raises:
        InputError: the distortion cannot be undone, or only one lens is a fisheye.
    """
    found = _pair(calibration, size, name) if stereo else _single(calibration.left, size)
    share = found.matrix[0, 0] / calibration.left.matrix[0, 0]
    lost = max((_lost(maps, size) for maps in found.maps if maps is not None), default=0.0)
    if lost > MOST_LOST or not LEAST_FOCAL_SHARE < share < MOST_FOCAL_SHARE:
        got = f"{share:.3g} times the focal length and {lost:.0%} of the image lost after it"
        raise input_error(
            name, "a distortion that can be undone", got, "Check the distortion, its model and the size of its images."
        )
    return found


def _lost(maps: Maps, size: tuple[int, int]) -> float:
    """Share of the rectified pixels that are outside of the source image, or whose neighbors change sides in it."""
    (x_down, x_across), (y_down, y_across) = (np.gradient(of) for of in maps)
    shown = (maps[0] > -1) & (maps[0] < size[0]) & (maps[1] > -1) & (maps[1] < size[1])
    return float((~shown | (x_across * y_down - x_down * y_across <= 0)).mean())


def stretched(maps: Maps | None, size: tuple[int, int], stretch: tuple[int, int]) -> Maps | None:
    """Maps into an image squeezed to 1 / stretch (across, down), from those into the image of this size."""
    if stretch == (1, 1):
        return maps
    columns, rows = identity(size) if maps is None else maps
    return (columns + np.float32(0.5)) / stretch[0] - np.float32(0.5), (rows + np.float32(0.5)) / stretch[
        1
    ] - np.float32(0.5)


def identity(size: tuple[int, int]) -> Maps:
    """Maps that change nothing."""
    columns, rows = np.meshgrid(np.arange(size[0], dtype=np.float32), np.arange(size[1], dtype=np.float32))
    return columns, rows


def _moved(matrix: NDArray, by: float) -> NDArray[np.float64]:
    """K with its principal point moved: OpenCV counts pixel centers from 0, this package from 0.5."""
    moved = matrix.copy()
    moved[:2, 2] += by
    return moved


def _maps(camera: Intrinsics, turn: NDArray, matrix: NDArray, size: tuple[int, int]) -> Maps:
    """Args: matrix: K of the rectified camera, px counted from 0."""
    make = cv2.fisheye.initUndistortRectifyMap if camera.fisheye else cv2.initUndistortRectifyMap
    return make(_moved(camera.matrix, -0.5), camera.distortion, turn, matrix, size, cv2.CV_32FC1)


def _single(camera: Intrinsics, size: tuple[int, int]) -> Rectified:
    if not camera.bent:
        return Rectified(camera.matrix, np.eye(3), (None, None))
    k = _moved(camera.matrix, -0.5)
    if camera.fisheye:
        better = cv2.fisheye.estimateNewCameraMatrixForUndistortRectify(
            k, camera.distortion, size, np.eye(3), balance=0
        )
    else:
        better = cv2.getOptimalNewCameraMatrix(k, camera.distortion, size, 0)[0]
    return Rectified(_moved(better, 0.5), np.eye(3), (_maps(camera, np.eye(3), better, size), None))


def _pair(calibration: Calibration, size: tuple[int, int], name: str) -> Rectified:
    left, right = calibration.left, calibration.right
    assert right is not None and calibration.rotation is not None and calibration.translation_mm is not None
    if calibration.rectified:
        return Rectified(left.matrix, np.eye(3), (None, None))
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
    return Rectified(_moved(p1[:, :3], 0.5), r1, maps)
