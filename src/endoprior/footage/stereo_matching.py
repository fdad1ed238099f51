"""Stereo pairs: dense matching, which image is the left one, and whether the rows are aligned.

The matcher is OpenCV's semi-global matching (H. Hirschmüller, "Stereo processing by semiglobal matching and mutual
information", PAMI 2008, with Birchfield and Tomasi's cost over blocks), along all eight directions.

A point at column x of the left image is at column x - disparity of the right one. `H, W` image size.
"""

from __future__ import annotations

from dataclasses import dataclass

import cv2
import numpy as np
from numpy.typing import NDArray

from ..core.checks import check_shape
from .image_operations import Image
from .keypoints import keypoints, match_descriptors

SMALL_STEP, LARGE_STEP = 16, 64
"""Penalty per block pixel for a disparity change of one px between neighbors, and for a larger change."""
UNIQUENESS_PERCENT = 10  # Margin by which the best match must beat the second best
CONTRAST_LIMIT = 31  # Image gradients are clipped to this before matching, levels
SEARCH_WIDTH = 320  # The order of the images is found at this width, px
NEAREST_SHARE = 0.2
"""Largest disparity of that search, as a share of the width: about that of a point 20 mm away at a 4 mm baseline."""
BLOCK_PX = 7  # Side of its matching blocks, px
AGREE_PX = 1.0  # Tolerance of its left-right consistency check, px
CLEARLY = 0.2  # The pair counts as swapped if the swapped order matches this much more of the image
FEATURES = 1000  # Largest number of features per image
RATIO = 0.75  # A feature's best match must be nearer than this times its second best (D. Lowe, IJCV 2004)
MIN_MATCHES = 20  # With fewer matches the vertical offset is unknown


def match_both_ways(
    left: Image, right: Image, lowest: int, highest: int, block: int
) -> tuple[NDArray[np.float32], NDArray[np.float32]]:
    """Disparity x_left - x_right, px in steps of 1/16, at the pixels of both gray images (H, W); NaN where no match is
    unique. A match outside the other image is extrapolated from neighbors. Disparities may be negative; the matching
    block has an odd side.
    """
    # After mirroring both images, the right image is matched like a left one.
    mirrored = _match(np.ascontiguousarray(right[:, ::-1]), np.ascontiguousarray(left[:, ::-1]), lowest, highest, block)
    return _match(left, right, lowest, highest, block), np.ascontiguousarray(mirrored[:, ::-1])


def disagreement(from_left: NDArray[np.float32], from_right: NDArray[np.float32]) -> NDArray[np.float32]:
    """(H, W) left-right consistency: difference of the two disparities at matching pixels, px; infinite where either is
    unknown, and where the match lies outside the right image.
    """
    height, width = from_left.shape
    known = np.isfinite(from_left)
    column = np.rint(np.arange(width) - np.where(known, from_left, 0)).astype(np.intp)
    known &= (column >= 0) & (column < width)
    partner = from_right[np.arange(height)[:, None], np.clip(column, 0, width - 1)]
    return np.where(known & np.isfinite(partner), np.abs(partner - from_left), np.inf).astype(np.float32)


def _match(near: Image, other: Image, lowest: int, highest: int, block: int) -> NDArray:
    """(H, W) disparity of `near`'s pixels, px; NaN where no match is unique."""
    count = -(-(highest - lowest + 1) // 16) * 16
    matcher = cv2.StereoSGBM.create(
        minDisparity=lowest,
        numDisparities=count,
        blockSize=block,
        P1=SMALL_STEP * block * block,
        P2=LARGE_STEP * block * block,
        disp12MaxDiff=-1,
        preFilterCap=CONTRAST_LIMIT,
        uniquenessRatio=UNIQUENESS_PERCENT,
        mode=cv2.STEREO_SGBM_MODE_HH,
    )
    # OpenCV leaves columns empty whose match could lie outside the image: add a margin.
    before, after = max(lowest + count, 0), max(-lowest, 0)
    wide = [cv2.copyMakeBorder(camera, 0, 0, before, after, cv2.BORDER_REPLICATE) for camera in (near, other)]
    sixteenths = matcher.compute(*wide)[:, before : before + near.shape[1]]
    return np.where(sixteenths >= 16 * lowest, sixteenths * np.float32(1 / 16), np.float32(np.nan))


@dataclass(frozen=True)
class StereoOrder:
    """Share of the image that matches in each order of the cameras, with positive depth; in [0, 1]."""

    as_given: float
    exchanged: float

    @property
    def swapped(self) -> bool:
        """Whether the first image is clearly that of the right camera."""
        return self.exchanged > self.as_given + CLEARLY

    @property
    def reason(self) -> str:
        """The measurements in one line."""
        return f"{self.as_given:.0%} of the image matches as given, {self.exchanged:.0%} swapped"


def stereo_order(left_u8: Image, right_u8: Image) -> StereoOrder:
    """Match a rectified pair, (H, W, 3) each, as given and swapped: in the right order all disparities are positive."""
    left, right = _gray(left_u8, right_u8)
    height, width = left.shape
    scale = min(1.0, SEARCH_WIDTH / width)
    size = max(round(width * scale), 1), max(round(height * scale), 1)
    left, right = (np.asarray(cv2.resize(x, size, interpolation=cv2.INTER_AREA), np.uint8) for x in (left, right))
    # Exclude 0, the disparity of infinity, which black margins and burned-in text have in either order.
    highest = 1 + max(int(NEAREST_SHARE * size[0]), 16)
    agree = (
        disagreement(*match_both_ways(*pair, 1, highest, BLOCK_PX)) <= AGREE_PX
        for pair in ((left, right), (right, left))
    )
    return StereoOrder(*(float(each.mean()) for each in agree))


def vertical_offset_px(left_u8: Image, right_u8: Image) -> float:
    """Median |y_left - y_right| of matching features of a pair (H, W, 3), px, or NaN; below 0.5 if it is rectified."""
    offsets = np.abs(row_offsets_px(left_u8, right_u8))
    return float(np.median(offsets)) if len(offsets) >= MIN_MATCHES else float("nan")


def row_offsets_px(left_u8: Image, right_u8: Image) -> NDArray[np.float64]:
    """(N,) y_right - y_left of each matching feature, px; arguments as for `vertical_offset_px`."""
    (left, left_descriptors), (right, right_descriptors) = (
        keypoints(camera, FEATURES) for camera in _gray(left_u8, right_u8)
    )
    if min(len(left), len(right)) < MIN_MATCHES:
        return np.zeros(0)
    of_left, of_right = match_descriptors(left_descriptors, right_descriptors, RATIO)
    return right[of_right, 1].astype(np.float64) - left[of_left, 1]


def _gray(left_u8: Image, right_u8: Image) -> list[Image]:
    check_shape("left_u8:H,W,3 right_u8:H,W,3", left_u8=left_u8, right_u8=right_u8)
    return [np.asarray(cv2.cvtColor(each, cv2.COLOR_RGB2GRAY), np.uint8) for each in (left_u8, right_u8)]
