"""Depth from a rectified stereo pair. `H, W` image size.

Disparity and depth: x_left - x_right = focal * baseline / z. Both rectified cameras have the same camera matrix.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import cv2
import numpy as np
from numpy.typing import NDArray

from ..core.checks import check_range
from ..footage.stereo_matching import disagreement, match_both_ways
from ..priors.specular import specular_likelihood

MATCHING_WIDTH = 960
"""Wider images are matched at a whole fraction of their size, px. The refinement uses the full size."""
TOLERANCE = 0.02  # relative difference up to which depths agree: about half a pixel of disparity at the usual distance
SURROUNDINGS_PX = 15  # side of the square around a pixel that counts as its surroundings
ROUNDS = 3  # Gauss-Newton steps of the refinement
WINDOW_SIGMA_PX = 5.0  # standard deviation of the Gaussian window over which one shift is estimated
NOISE_VARIANCE = 4.0  # sensor noise of the gray images, levels^2: weaker gradients do not change the disparity
OUTLIER_LEVELS = 6.0  # brightness difference between the cameras at which a pixel has half weight
MAX_CHANGE_PX = 0.5
"""Largest change by a step, and by the whole refinement; limits the damage of windows across a depth edge."""
SMOOTHING_PX, SMOOTHING_SIGMA_PX = 15, 5.0  # size and standard deviation of the smoothing window ...
SMOOTHING_STEP_PX = 0.5  # ... and the difference of disparity between neighbors on different surfaces, px
SPECKLE_STEP_PX = 1.0  # neighbors whose disparities differ by more belong to different regions
PLANE_RESIDUAL_PX = 0.35  # a hole is filled if 90 % of its rim lies on a plane to within this, px of disparity
BLOCK_PX, LEFT_RIGHT_PX = 7, 1.0  # side of the matching blocks, and tolerance of the left-right consistency check
SPECKLE_PX, FILL_PX = 150, 400  # isolated regions of fewer pixels are removed, holes of at most so many are filled
MIN_CONFIDENCE = 0.1  # depth of lower confidence is removed

Image = NDArray[np.uint8]


@dataclass(frozen=True)
class StereoConfig:
    """Options of stereo matching."""

    near_mm: float = 25.0
    """Smallest depth of the search, mm, 1..10000; a smaller value takes more time."""
    far_mm: float = 300.0
    """Largest depth of the search, mm, at most 100000."""

    def __post_init__(self) -> None:
        check_range("near_mm", self.near_mm, 1, 1e4)
        check_range("far_mm", self.far_mm, 1, 1e5)
        if not self.near_mm < self.far_mm:
            raise ValueError(f"far_mm must be more than near_mm, got {self.far_mm:g} and {self.near_mm:g}")


def stereo_depth(
    left_u8: Image, right_u8: Image, focal_px: float, baseline_mm: float, cfg: StereoConfig | None = None
) -> NDArray:
    """(H, W) depth, mm, of every pixel of the left image that passes the left-right consistency check, else 0.

    Confidence is the product of left-right consistency, texture and absence of highlights, which move with the camera
    rather than with the tissue.

    Args:
        left_u8, right_u8: (H, W, 3) rectified images, 0..255.
        focal_px, baseline_mm: of the rectified cameras.
        cfg: the depth is within its [near_mm, far_mm].
    Raises:
        ValueError: a depth range that is impossible for this image size.
    """
    cfg = cfg or StereoConfig()
    width = left_u8.shape[1]
    product = np.float64(focal_px * baseline_mm)  # so that NumPy divides by float32 disparities in float64
    lowest, highest = product / cfg.far_mm, min(product / cfg.near_mm, width - 1)
    if lowest > highest:
        raise ValueError(
            f"far_mm must be more than {product / max(width - 1, 1e-6):.4g} for "
            f"focal_px {focal_px:g}, baseline_mm {baseline_mm:g} and images {width} px wide, got {cfg.far_mm:g}"
        )
    left, right = (cv2.cvtColor(camera, cv2.COLOR_RGB2GRAY) for camera in (left_u8, right_u8))
    disparity, apart = _match_consistently(left, right, lowest, highest)
    # Smooth first: the refinement shifts whole windows and would keep the matcher's steps inside them.
    disparity, texture = refine_disparity(left, right, smooth_disparity(disparity))
    glint = specular_likelihood(left_u8 * np.float32(1 / 255))
    confidence = texture * np.exp(-((apart / np.float32(LEFT_RIGHT_PX)) ** 2)) * (1 - glint / 2)
    disparity[~(confidence >= MIN_CONFIDENCE)] = np.nan
    disparity = fill_small_holes(smooth_disparity(drop_speckles(disparity, SPECKLE_PX)), FILL_PX)
    # This comparison also excludes NaN and disparities of the wrong sign.
    valid = (disparity >= lowest) & (disparity <= product / cfg.near_mm)
    return np.divide(product, disparity, out=np.zeros_like(disparity), where=valid)


def temporal_median(window: Sequence[NDArray]) -> NDArray:
    """(H, W) depth, mm, of the middle frame of a window after a median filter over time; 0 where missing.

    Frames enter in pairs, one before and one after at equal distance, and only at pixels where both agree with the
    middle frame. Steady motion therefore adds no bias, and a sudden change keeps the value of the middle frame. A hole
    is filled by the nearest pair if its two frames agree with each other and with the depth around the hole.

    Args:
        window: an odd number of (H, W) depth maps, mm, 0 where missing.
    """
    half = len(window) // 2
    middle = window[half]
    measured = middle > 0
    votes = [middle]
    for away in range(1, half + 1):
        before, after = window[half - away], window[half + away]
        agree = np.maximum(np.abs(before - middle), np.abs(after - middle)) <= np.float32(TOLERANCE) * middle
        # a pair of opposite infinities does not change the median.
        votes += [np.where(agree, before, -np.inf), np.where(agree, after, np.inf)]
    median = np.partition(np.stack(votes), half, axis=0)[half] if half else middle
    result = np.where(measured, median, 0).astype(np.float32)
    if half and not measured.all():
        before, after = window[half - 1], window[half + 1]
        between = (before + after) / 2
        around = _mean_around(middle, measured)
        static = np.abs(before - after) <= np.float32(TOLERANCE) * between
        fits = np.abs(between - around) <= np.float32(2 * TOLERANCE) * around
        fill = ~measured & (before > 0) & (after > 0) & static & fits
        result[fill] = between[fill]
    return result


def _match_consistently(left: NDArray, right: NDArray, lowest: float, highest: float) -> tuple[NDArray, NDArray]:
    """(H, W) disparity of the left image, NaN where the consistency check fails; (H, W) left-right difference, px."""
    height, width = left.shape
    times = -(-width // MATCHING_WIDTH)
    size = (-(-width // times), -(-height // times))
    scale = width / size[0]
    if times > 1:
        left, right = (cv2.resize(camera, size, interpolation=cv2.INTER_AREA) for camera in (left, right))
    bounds = int(np.floor(lowest / scale)), int(np.ceil(highest / scale))
    from_left, from_right = match_both_ways(left, right, *bounds, BLOCK_PX)
    apart = disagreement(from_left, from_right)
    from_left[apart > LEFT_RIGHT_PX] = np.nan
    if times == 1:
        return from_left, apart
    from_left, apart = (
        cv2.resize(each, (width, height), interpolation=cv2.INTER_NEAREST) for each in (from_left, apart)
    )
    return from_left * np.float32(scale), apart


def _mean_around(values: NDArray, measured: NDArray) -> NDArray:
    """(H, W) mean of the measured values in a square around each pixel; 0 if there are none."""
    weight = measured.astype(np.float32)
    total = cv2.blur(values * weight, (SURROUNDINGS_PX, SURROUNDINGS_PX))
    share = cv2.blur(weight, (SURROUNDINGS_PX, SURROUNDINGS_PX))
    return np.divide(total, share, out=np.zeros_like(total), where=share > 1e-6)


def refine_disparity(left: NDArray, right: NDArray, disparity: NDArray) -> tuple[NDArray, NDArray]:
    """Refine each disparity by matching a Gaussian window of both gray images (H, W).

    Semi-global matching prefers whole and half pixels ("pixel locking"). This function warps the right image onto the
    left one and estimates the remaining shift by least squares on gradients (B. Lucas and T. Kanade, IJCAI 1981, along
    rows only). It first removes smooth brightness differences; outliers get a low weight.

    Returns:
        (H, W) disparity, px, NaN where it was; (H, W) texture in [0, 1): near 1 where gradients along rows are far
        above the noise.
    """
    known = np.isfinite(disparity)
    trust = known.astype(np.float32)
    total = _window(trust) + np.float32(1e-6)
    start = moved = np.where(known, disparity, np.float32(0))
    texture, left_gray, right_gray = start, left.astype(np.float32), right.astype(np.float32)
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
        step = np.clip(step, -MAX_CHANGE_PX, MAX_CHANGE_PX)
        moved = np.clip(moved - step, start - MAX_CHANGE_PX, start + MAX_CHANGE_PX)
        texture = strength / (strength + np.float32(NOISE_VARIANCE))
    return np.where(known, moved, np.float32(np.nan)), texture


def smooth_disparity(disparity: NDArray) -> NDArray:
    """(H, W) `disparity` after a bilateral filter, which keeps depth edges; NaN at the same pixels."""
    known = np.isfinite(disparity)
    if not known.any():
        return disparity
    apart = disparity[known].min() - 40 * np.float32(SMOOTHING_STEP_PX)  # so far that the weight is 0
    smooth = cv2.bilateralFilter(np.where(known, disparity, apart), SMOOTHING_PX, SMOOTHING_STEP_PX, SMOOTHING_SIGMA_PX)
    return np.where(known, smooth, np.float32(np.nan))


def drop_speckles(disparity: NDArray, smallest_px: int) -> NDArray:
    """(H, W) `disparity` without isolated regions of fewer than `smallest_px` pixels."""
    unknown = -(2**15)
    sixteenths = np.where(np.isfinite(disparity), np.rint(disparity * 16), unknown).astype(np.int16)
    cv2.filterSpeckles(sixteenths, unknown, smallest_px, 16 * SPECKLE_STEP_PX)
    return np.where(sixteenths == unknown, np.float32(np.nan), disparity)


def fill_small_holes(disparity: NDArray, largest_px: int) -> NDArray:
    """(H, W) disparity whose holes (NaN) of at most `largest_px` pixels with a rim on a plane are filled.

    Holes at depth edges and at the image border stay. A plane in space is also a plane in disparity.
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
        hole, around = labels[part] == label, disparity[part]
        rim = (cv2.dilate(hole.astype(np.uint8), square) > 0) & np.isfinite(around)
        plane = _plane(rim, around[rim])
        if plane is not None:
            filled[part][hole] = _coordinates(hole) @ plane
    return filled


def _plane(rim: NDArray, values: NDArray) -> NDArray | None:
    """(3,) the plane through `values` at the pixels of `rim`; None if the residual is too large."""
    if values.size < 8:
        return None
    at = _coordinates(rim)
    plane, _, rank, _ = np.linalg.lstsq(at, values.astype(np.float64), rcond=None)
    smooth = np.quantile(np.abs(at @ plane - values), 0.9) <= PLANE_RESIDUAL_PX
    return plane if rank == 3 and smooth else None


def _coordinates(mask: NDArray) -> NDArray:
    """(n, 3) column, row and 1 of the pixels of `mask`."""
    rows, columns = np.nonzero(mask)
    return np.column_stack([columns, rows, np.ones(rows.size)]).astype(np.float64)


def _window(values: NDArray) -> NDArray:
    return cv2.GaussianBlur(values, (0, 0), WINDOW_SIGMA_PX)
