"""Stereo pairs: dense matching both ways, which image is the left one, and are the rows aligned? `H, W` image size.

The matcher is OpenCV's semi-global matching (H. Hirschmüller, "Stereo processing by semiglobal matching and mutual
information", PAMI 2008, with Birchfield and Tomasi's cost over blocks), along all eight directions.
"""

from __future__ import annotations

from dataclasses import dataclass

import cv2
import numpy as np
from numpy.typing import NDArray

from ..core.checks import check_shape

SMALL_STEP, LARGE_STEP = 16, 64
"""Penalty per block pixel for a disparity change of one px between neighbors, and for a larger change."""
UNIQUENESS_PERCENT = 10
"""Margin by which the best match must beat the second best."""
CONTRAST_LIMIT = 31
"""Image gradients are clipped to this before matching, levels."""


def match_both_ways(
    left: NDArray[np.uint8], right: NDArray[np.uint8], lowest: int, highest: int, block: int
) -> tuple[NDArray[np.float32], NDArray[np.float32]]:
    """Disparity x_left - x_right at the pixels of either image.

    A pixel whose match lies outside the other image still gets a value, extrapolated from its neighbors.

    Args:
        left, right: (H, W) gray.
        lowest, highest: range of disparities, px; may be negative.
        block: side of the matching blocks, px, odd.
    Returns:
        (H, W) disparity of the left image and (H, W) of the right image, px in steps of 1/16; NaN where no match is
        unique.
    """
    # After mirroring both images, the right image is matched like a left one.
    mirrored = _match(np.ascontiguousarray(right[:, ::-1]), np.ascontiguousarray(left[:, ::-1]), lowest, highest, block)
    return _match(left, right, lowest, highest, block), np.ascontiguousarray(mirrored[:, ::-1])


def disagreement(from_left: NDArray[np.float32], from_right: NDArray[np.float32]) -> NDArray[np.float32]:
    """(H, W) left-right consistency: difference of the two disparities at matching pixels, px.

    Infinite where either is unknown, and where the match lies outside the right image.
    """
    height, width = from_left.shape
    known = np.isfinite(from_left)
    column = np.rint(np.arange(width) - np.where(known, from_left, 0)).astype(np.intp)
    known &= (column >= 0) & (column < width)
    partner = from_right[np.arange(height)[:, None], np.clip(column, 0, width - 1)]
    return np.where(known & np.isfinite(partner), np.abs(partner - from_left), np.inf).astype(np.float32)


def _match(near: NDArray[np.uint8], other: NDArray[np.uint8], lowest: int, highest: int, block: int) -> NDArray:
    """(H, W) disparity of `near`'s pixels, px; NaN where no match is unique."""
    count = -(-(highest - lowest + 1) // 16) * 16
    matcher = cv2.StereoSGBM_create(
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
    found = sixteenths >= 16 * lowest
    return np.where(found, sixteenths * np.float32(1 / 16), np.float32(np.nan))


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
