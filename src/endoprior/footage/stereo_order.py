"""Check a stereo pair: which image is the left one, and are the rows aligned? `H, W` image size."""

from __future__ import annotations

from dataclasses import dataclass

import cv2
import numpy as np
from numpy.typing import NDArray

from ..core.checks import check_shape
from .stereo_matching import disagreement, match_both_ways

LOOK_WIDTH = 320
"""Images are matched at this width, px."""
NEAREST_SHARE = 0.2
"""Largest disparity of the search, as a share of the width: about that of a point 20 mm away at a 4 mm baseline."""
BLOCK_PX = 7
"""Side of the matching blocks, px."""
AGREE_PX = 1.0
"""Tolerance of the left-right consistency check, px."""
CLEARLY = 0.2
"""The pair counts as swapped if the swapped order matches this much more of the image."""
FEATURES = 1000
"""Largest number of features per image."""
RATIO = 0.75
"""A feature's best match must be nearer than this times its second best (D. Lowe, IJCV 2004)."""
FEWEST_MATCHES = 20
"""With fewer matches the vertical offset is unknown."""


@dataclass(frozen=True)
class StereoOrder:
    """Share of the image that matches in each order of the cameras, with positive depth; in [0, 1]."""

    as_given: float
    exchanged: float

    @property
    def swapped(self) -> bool:
        """Whether the first image is clearly that of the right camera."""
        return self.exchanged > self.as_given + CLEARLY


def stereo_order(left_u8: NDArray[np.uint8], right_u8: NDArray[np.uint8]) -> StereoOrder:
    """Match a rectified pair as given and swapped. In the correct order all disparities are positive.

    Args:
        left_u8, right_u8: (H, W, 3) rectified images, 0..255.
    Returns:
        the share of pixels that pass the left-right consistency check, in either order.
    Raises:
        ValueError: wrong shapes.
    """
    left, right = _gray(left_u8, right_u8)
    height, width = left.shape
    scale = min(1.0, LOOK_WIDTH / width)
    size = max(round(width * scale), 1), max(round(height * scale), 1)
    left, right = (cv2.resize(camera, size, interpolation=cv2.INTER_AREA) for camera in (left, right))
    return StereoOrder(_explained(left, right), _explained(right, left))


def vertical_offset_px(left_u8: NDArray[np.uint8], right_u8: NDArray[np.uint8]) -> float:
    """Vertical offset of a stereo pair: the median |y_left - y_right| of matching features.

    A rectified pair has less than about half a pixel.

    Args:
        left_u8, right_u8: (H, W, 3) images, 0..255.
    Returns:
        px; NaN if too few features match.
    Raises:
        ValueError: wrong shapes.
    """
    offsets = np.abs(row_offsets_px(left_u8, right_u8))
    return float(np.median(offsets)) if len(offsets) >= FEWEST_MATCHES else float("nan")


def row_offsets_px(left_u8: NDArray[np.uint8], right_u8: NDArray[np.uint8]) -> NDArray[np.float64]:
    """(N,) y_right - y_left of each matching feature, px; arguments as for `vertical_offset_px`."""
    finder = cv2.SIFT_create(FEATURES)
    (left, left_marks), (right, right_marks) = (
        finder.detectAndCompute(camera, None) for camera in _gray(left_u8, right_u8)
    )
    if min(len(left), len(right)) < FEWEST_MATCHES:
        return np.zeros(0)
    pairs = cv2.BFMatcher().knnMatch(left_marks, right_marks, k=2)
    good = [best for best, second in pairs if best.distance < RATIO * second.distance]
    return np.array([right[m.trainIdx].pt[1] - left[m.queryIdx].pt[1] for m in good])


def _gray(left_u8: NDArray[np.uint8], right_u8: NDArray[np.uint8]) -> tuple[NDArray[np.uint8], NDArray[np.uint8]]:
    """Both images in gray, checked."""
    check_shape("left_u8:H,W,3 right_u8:H,W,3", left_u8=left_u8, right_u8=right_u8)
    return cv2.cvtColor(left_u8, cv2.COLOR_RGB2GRAY), cv2.cvtColor(right_u8, cv2.COLOR_RGB2GRAY)


def _explained(left: NDArray[np.uint8], right: NDArray[np.uint8]) -> float:
    """Share of the left image's pixels that pass the left-right consistency check with positive disparity."""
    # Exclude 0, the disparity of infinity, which black margins and burned-in text have in either order.
    highest = 1 + max(int(NEAREST_SHARE * left.shape[1]), 16)
    apart = disagreement(*match_both_ways(left, right, 1, highest, BLOCK_PX))
    return float((apart <= AGREE_PX).mean())
