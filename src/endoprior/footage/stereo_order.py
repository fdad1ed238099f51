"""Whether two images are what a left and a right camera see, row by row. `H, W` image size."""

from __future__ import annotations

from dataclasses import dataclass

import cv2
import numpy as np
from numpy.typing import NDArray

from ..core.checks import check_shape
from .stereo_matching import disagreement, match_both_ways

LOOK_WIDTH = 320
"""Width at which the cameras are told apart, px."""
NEAREST_SHARE = 0.2
"""Largest disparity looked for, as a share of the width: cameras 4 mm apart see 20 mm away at about that."""
BLOCK_PX = 7
"""Side of the blocks that are compared at that width, px."""
AGREE_PX = 1.0
"""The cameras' disparities of a point may differ by this much at that width, px."""
CLEARLY = 0.2
"""The exchanged order must explain this much more of the image before it is believed."""
FEATURES = 1000
"""Most features looked at in each image."""
RATIO = 0.75
"""A feature's best match must be nearer than this times its second best (D. Lowe, IJCV 2004)."""
FEWEST_MATCHES = 20
"""Fewer say nothing about rows."""


@dataclass(frozen=True)
class StereoOrder:
    """How much of the image each order of the cameras explains by surfaces in front of them, each in [0, 1]."""

    as_given: float
    exchanged: float

    @property
    def swapped(self) -> bool:
        """Whether the first image is clearly the right camera's."""
        return self.exchanged > self.as_given + CLEARLY


def stereo_order(left_u8: NDArray[np.uint8], right_u8: NDArray[np.uint8], center_shift_px: float = 0.0) -> StereoOrder:
    """Match a rectified pair both as it is and exchanged: in the right order nothing lies behind infinity.

    Args:
        left_u8, right_u8: (H, W, 3) rectified images, 0..255.
        center_shift_px: cx_left - cx_right, the disparity of infinity, px.
    Returns:
        the share of pixels on which both cameras agree, in either order.
    Raises:
        ValueError: other shapes.
    """
    left, right = _gray(left_u8, right_u8)
    height, width = left.shape
    scale = min(1.0, LOOK_WIDTH / width)
    size = max(round(width * scale), 1), max(round(height * scale), 1)
    left, right = (cv2.resize(camera, size, interpolation=cv2.INTER_AREA) for camera in (left, right))
    shift = center_shift_px * scale
    return StereoOrder(_explained(left, right, shift), _explained(right, left, -shift))


def vertical_offset_px(left_u8: NDArray[np.uint8], right_u8: NDArray[np.uint8]) -> float:
    """How far the rows of two images are apart: the median |y_left - y_right| of matching features.

    A rectified pair stays below about half a pixel.

    Args:
        left_u8, right_u8: (H, W, 3) images, 0..255.
    Returns:
        px; NaN where too few features match to say.
    Raises:
        ValueError: other shapes.
    """
    finder = cv2.SIFT_create(FEATURES)
    (left, left_marks), (right, right_marks) = (
        finder.detectAndCompute(camera, None) for camera in _gray(left_u8, right_u8)
    )
    if min(len(left), len(right)) < FEWEST_MATCHES:
        return float("nan")
    pairs = cv2.BFMatcher().knnMatch(left_marks, right_marks, k=2)
    good = [best for best, second in pairs if best.distance < RATIO * second.distance]
    if len(good) < FEWEST_MATCHES:
        return float("nan")
    return float(np.median([abs(left[m.queryIdx].pt[1] - right[m.trainIdx].pt[1]) for m in good]))


def _gray(left_u8: NDArray[np.uint8], right_u8: NDArray[np.uint8]) -> tuple[NDArray[np.uint8], NDArray[np.uint8]]:
    """Both images in gray, checked."""
    check_shape("left_u8:H,W,3 right_u8:H,W,3", left_u8=left_u8, right_u8=right_u8)
    return cv2.cvtColor(left_u8, cv2.COLOR_RGB2GRAY), cv2.cvtColor(right_u8, cv2.COLOR_RGB2GRAY)


def _explained(left: NDArray[np.uint8], right: NDArray[np.uint8], shift: float) -> float:
    """Share of the left image's pixels whose disparity both cameras agree on, all of it in front of infinity."""
    # The disparity of infinity itself belongs to neither order: black margins and burned-in text have it.
    lowest = int(np.floor(shift)) + 1
    highest = lowest + max(int(NEAREST_SHARE * left.shape[1]), 16)
    apart = disagreement(*match_both_ways(left, right, lowest, highest, BLOCK_PX))
    return float((apart <= AGREE_PX).mean())
