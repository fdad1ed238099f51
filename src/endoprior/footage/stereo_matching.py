"""Dense matching of a rectified pair, from left to right and from right to left. `H, W` image size.

The matcher is OpenCV's semi-global matching (H. Hirschmüller, "Stereo processing by semiglobal matching and mutual
information", PAMI 2008, with Birchfield and Tomasi's cost over blocks), along all eight directions.
"""

from __future__ import annotations

import cv2
import numpy as np
from numpy.typing import NDArray

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
