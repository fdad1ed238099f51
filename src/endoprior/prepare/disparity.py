"""Refinement of disparity maps: sub-pixel precision, speckle removal, filling of small holes. `H, W` image size."""

from __future__ import annotations

import cv2
import numpy as np
from numpy.typing import NDArray

ROUNDS = 3
"""Gauss-Newton steps of the refinement."""
WINDOW_SIGMA_PX = 5.0
"""Standard deviation of the Gaussian window over which one shift is estimated."""
NOISE_VARIANCE = 4.0
"""Sensor noise of the gray images, levels^2: weaker gradients do not change the disparity."""
OUTLIER_LEVELS = 6.0
"""Brightness difference between the cameras at which a pixel has half weight."""
MAX_CHANGE_PX = 0.5
"""Largest change by the refinement; limits the damage of windows across a depth edge."""
SMOOTHING_PX, SMOOTHING_SIGMA_PX = 15, 5.0
"""Size and standard deviation of the smoothing window ..."""
SMOOTHING_STEP_PX = 0.5
"""... and the difference of disparity between neighbors on different surfaces, px."""
SPECKLE_STEP_PX = 1.0
"""Neighbors whose disparities differ by more belong to different regions."""
PLANE_RESIDUAL_PX = 0.35
"""A hole is filled if 90 % of its rim lies on a plane to within this, px of disparity."""


def refine_disparity(
    left: NDArray[np.uint8], right: NDArray[np.uint8], disparity: NDArray[np.float32]
) -> tuple[NDArray[np.float32], NDArray[np.float32]]:
    """Refine each disparity by matching a Gaussian window of both images.

    Semi-global matching prefers whole and half pixels ("pixel locking"). This function warps the right image onto the
    left one and estimates the remaining shift by least squares on gradients (B. Lucas and T. Kanade, IJCAI 1981, along
    rows only). It first removes smooth brightness differences; outliers get a low weight.

    Args:
        left, right: (H, W) gray.
        disparity: (H, W) px; NaN where unknown.
    Returns:
        (H, W) disparity, px, NaN at the same pixels; (H, W) texture in [0, 1): near 1 where gradients along rows are
        far above the noise.
    """
    known = np.isfinite(disparity)
    trust = known.astype(np.float32)
    total = _window(trust) + np.float32(1e-6)
    start = np.where(known, disparity, np.float32(0))
    moved = start
    left_gray, right_gray = left.astype(np.float32), right.astype(np.float32)
    column = np.arange(left.shape[1], dtype=np.float32)[None]
    row = np.broadcast_to(np.arange(left.shape[0], dtype=np.float32)[:, None], left.shape).copy()
    for _ in range(ROUNDS):
        warped = cv2.remap(right_gray, column - moved, row, cv2.INTER_CUBIC, borderMode=cv2.BORDER_REPLICATE)
        slope = cv2.filter2D((left_gray + warped) / 2, -1, np.array([[-0.5, 0, 0.5]], np.float32))
        difference = left_gray - warped
        difference -= _window(trust * difference) / total
        weighted = trust / (1 + (difference / np.float32(OUTLIER_LEVELS)) ** 2) * slope
        strength = _window(weighted * slope)
        step = _window(weighted * difference) / (strength + np.float32(NOISE_VARIANCE))
        moved = np.clip(moved - np.clip(step, -0.5, 0.5), start - MAX_CHANGE_PX, start + MAX_CHANGE_PX)
    texture = strength / (strength + np.float32(NOISE_VARIANCE))
    return np.where(known, moved, np.float32(np.nan)), texture


def smooth_disparity(disparity: NDArray[np.float32]) -> NDArray[np.float32]:
    """(H, W) `disparity` after a bilateral filter, which keeps depth edges; NaN at the same pixels."""
    known = np.isfinite(disparity)
    if not known.any():
        return disparity
    apart = disparity[known].min() - 40 * np.float32(SMOOTHING_STEP_PX)  # so far that the weight is 0
    smooth = cv2.bilateralFilter(np.where(known, disparity, apart), SMOOTHING_PX, SMOOTHING_STEP_PX, SMOOTHING_SIGMA_PX)
    return np.where(known, smooth, np.float32(np.nan))


def drop_speckles(disparity: NDArray[np.float32], smallest_px: int) -> NDArray[np.float32]:
    """(H, W) `disparity` without isolated regions of fewer than `smallest_px` pixels."""
    unknown = -(2**15)
    sixteenths = np.where(np.isfinite(disparity), np.rint(disparity * 16), unknown).astype(np.int16)
    cv2.filterSpeckles(sixteenths, unknown, smallest_px, 16 * SPECKLE_STEP_PX)
    return np.where(sixteenths == unknown, np.float32(np.nan), disparity)


def fill_small_holes(disparity: NDArray[np.float32], largest_px: int) -> NDArray[np.float32]:
    """Fill holes of at most `largest_px` pixels whose rim lies on a plane; leave all others.

    Holes at depth edges and at the image border stay. A plane in space is also a plane in disparity.

    Args:
        disparity: (H, W) px; NaN where unknown.
    Returns:
        (H, W) disparity, px.
    """
    filled = disparity.copy()
    missing = np.isnan(disparity).astype(np.uint8)
    _, labels, stats, _ = cv2.connectedComponentsWithStats(missing, connectivity=8)
    height, width = disparity.shape
    square = np.ones((5, 5), np.uint8)
    for label, (x, y, w, h, area) in enumerate(stats[1:], 1):
        if area > largest_px or x == 0 or y == 0 or x + w == width or y + h == height:
            continue
        part = np.s_[max(y - 2, 0) : y + h + 2, max(x - 2, 0) : x + w + 2]
        hole = labels[part] == label
        around = disparity[part]
        rim = (cv2.dilate(hole.astype(np.uint8), square) > 0) & np.isfinite(around)
        plane = _plane(rim, around[rim])
        if plane is not None:
            filled[part][hole] = _coordinates(hole) @ plane
    return filled


def _plane(rim: NDArray[np.bool_], values: NDArray[np.float32]) -> NDArray[np.float64] | None:
    """(3,) the plane through `values` at the pixels of `rim`; None if the residual is too large."""
    if values.size < 8:
        return None
    at = _coordinates(rim)
    plane, _, rank, _ = np.linalg.lstsq(at, values.astype(np.float64), rcond=None)
    smooth = np.quantile(np.abs(at @ plane - values), 0.9) <= PLANE_RESIDUAL_PX
    return plane if rank == 3 and smooth else None


def _coordinates(mask: NDArray[np.bool_]) -> NDArray[np.float64]:
    """(n, 3) column, row and 1 of the pixels of `mask`."""
    rows, columns = np.nonzero(mask)
    return np.column_stack([columns, rows, np.ones(rows.size)]).astype(np.float64)


def _window(values: NDArray[np.float32]) -> NDArray[np.float32]:
    """(H, W) Gaussian mean."""
    return cv2.GaussianBlur(values, (0, 0), WINDOW_SIGMA_PX)
