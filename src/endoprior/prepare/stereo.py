"""Depth from a rectified stereo pair. `H, W` image size.

Disparity and depth: x_left - x_right = focal * baseline / z. Both rectified cameras have the same camera matrix.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import cv2
import numpy as np
from numpy.typing import NDArray

from ..core.checks import check_range, check_shape
from ..footage.stereo_order import disagreement, match_both_ways
from ..priors.specular import specular_likelihood
from .disparity import drop_speckles, fill_small_holes, refine_disparity, smooth_disparity

MATCHING_WIDTH = 960
"""Wider images are matched at a whole fraction of their size, px. The refinement uses the full size."""
TOLERANCE = 0.02
"""Relative difference up to which depths agree: about half a pixel of disparity at the usual distance."""
SURROUNDINGS_PX = 15
"""Side of the square around a pixel that counts as its surroundings."""


@dataclass(frozen=True)
class StereoConfig:
    """Options of stereo matching."""

    near_mm: float = 25.0
    """Smallest depth of the search, mm, 1..10000; a smaller value takes more time."""
    far_mm: float = 300.0
    """Largest depth of the search, mm, at most 100000."""
    block_px: int = 7
    """Side of the matching blocks, px, odd, 3..15: larger is smoother."""
    left_right_px: float = 1.0
    """Tolerance of the left-right consistency check, px, 0.1..10."""
    speckle_px: int = 150
    """Isolated regions of fewer pixels are removed, 0..1000000."""
    fill_px: int = 400
    """Holes of at most this many pixels in a smooth surface are filled, 0..1000000."""
    min_confidence: float = 0.1
    """Depth of lower confidence is removed, 0..1."""

    def __post_init__(self) -> None:
        check_range("near_mm", self.near_mm, 1, 1e4)
        check_range("far_mm", self.far_mm, 1, 1e5)
        if not self.near_mm < self.far_mm:
            raise ValueError(f"far_mm must be more than near_mm, got {self.far_mm:g} and {self.near_mm:g}")
        check_range("block_px", self.block_px, 3, 15)
        if self.block_px % 2 == 0:
            raise ValueError(f"block_px must be odd, got {self.block_px}")
        check_range("left_right_px", self.left_right_px, 0.1, 10)
        check_range("speckle_px", self.speckle_px, 0, 1_000_000)
        check_range("fill_px", self.fill_px, 0, 1_000_000)
        check_range("min_confidence", self.min_confidence, 0, 1)


@dataclass(frozen=True)
class StereoDepth:
    """Depth and confidence of the left image."""

    depth: NDArray[np.float32]
    """(H, W) z, mm; 0 where not measured."""
    confidence: NDArray[np.float32]
    """(H, W) in [0, 1]; 0 where not measured."""


def stereo_depth(
    left_u8: NDArray[np.uint8],
    right_u8: NDArray[np.uint8],
    focal_px: float,
    baseline_mm: float,
    cfg: StereoConfig | None = None,
) -> StereoDepth:
    """Depth of every pixel of the left image that passes the left-right consistency check.

    Occluded pixels get no depth. Highlights move with the camera rather than with the tissue, so their confidence is
    halved, as is that of filled holes.

    Args:
        left_u8, right_u8: (H, W, 3) rectified images, 0..255.
        focal_px: focal length of the rectified images, > 0.
        baseline_mm: distance between the cameras, > 0.
        cfg: range and thresholds.
    Returns:
        depth within [near_mm, far_mm], and confidence: the product of left-right consistency, texture and absence of
        highlights.
    Raises:
        ValueError: wrong shapes or types, or a depth range that is impossible for this image size.
    """
    cfg = cfg or StereoConfig()
    check_shape("left_u8:H,W,3 right_u8:H,W,3", left_u8=left_u8, right_u8=right_u8)
    if left_u8.dtype != np.uint8 or right_u8.dtype != np.uint8:
        raise ValueError(f"images must be 8-bit, got {left_u8.dtype} and {right_u8.dtype}")
    check_range("focal_px", focal_px, 1, 1e6)
    check_range("baseline_mm", baseline_mm, 1e-3, 1e4)
    width = left_u8.shape[1]
    product = np.float64(focal_px * baseline_mm)  # so that NumPy divides by float32 disparities in float64
    lowest, highest = product / cfg.far_mm, min(product / cfg.near_mm, width - 1)
    if lowest > highest:
        raise ValueError(
            f"far_mm must be more than {product / max(width - 1, 1e-6):.4g} for "
            f"focal_px {focal_px:g}, baseline_mm {baseline_mm:g} and images {width} px wide, got {cfg.far_mm:g}"
        )
    left, right = (cv2.cvtColor(camera, cv2.COLOR_RGB2GRAY) for camera in (left_u8, right_u8))
    disparity, apart = _match_consistently(left, right, lowest, highest, cfg)
    # Smooth first: the refinement shifts whole windows and would keep the matcher's steps inside them.
    disparity, texture = refine_disparity(left, right, smooth_disparity(disparity))
    glint = specular_likelihood(left_u8 * np.float32(1 / 255))
    confidence = texture * np.exp(-((apart / np.float32(cfg.left_right_px)) ** 2)) * (1 - glint / 2)
    disparity[~(confidence >= cfg.min_confidence)] = np.nan
    disparity = smooth_disparity(drop_speckles(disparity, cfg.speckle_px))
    confidence[np.isnan(disparity)] = 0
    disparity = fill_small_holes(disparity, cfg.fill_px)
    filled = (confidence == 0) & np.isfinite(disparity)
    if filled.any():
        support = np.isfinite(disparity) & ~filled
        confidence[filled] = _mean_around(confidence, support)[filled] / 2
    # This comparison also excludes NaN and disparities of the wrong sign.
    valid = (disparity >= lowest) & (disparity <= product / cfg.near_mm)
    depth = np.divide(product, disparity, out=np.zeros_like(disparity), where=valid)
    return StereoDepth(depth, np.where(valid, confidence, np.float32(0)))


def temporal_median(window: Sequence[NDArray[np.float32]]) -> NDArray[np.float32]:
    """Temporal median filter of depth for the middle frame of a window.

    Frames enter in pairs, one before and one after at equal distance, and only at pixels where both agree with the
    middle frame. Steady motion therefore adds no bias, and a sudden change keeps the value of the middle frame. A hole
    is filled by the nearest pair if its two frames agree with each other and with the depth around the hole.

    Args:
        window: an odd number of (H, W) depth maps, mm, 0 where missing; the middle one is filtered.

    Returns:
        (H, W) depth, mm; 0 where missing.
    Raises:
        ValueError: an even number of maps, or maps of different sizes.
    """
    if len(window) % 2 == 0:
        raise ValueError(f"window must have an odd number of depth maps, got {len(window)}")
    for depth in window:
        check_shape("depth:H,W middle:H,W", depth=depth, middle=window[len(window) // 2])
    half = len(window) // 2
    middle = window[half]
    measured = middle > 0
    votes = [middle]
    for away in range(1, half + 1):
        before, after = window[half - away], window[half + away]
        agree = np.maximum(np.abs(before - middle), np.abs(after - middle)) <= np.float32(TOLERANCE) * middle
        # A pair of opposite infinities does not change the median.
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


def _match_consistently(
    left: NDArray[np.uint8], right: NDArray[np.uint8], lowest: float, highest: float, cfg: StereoConfig
) -> tuple[NDArray[np.float32], NDArray[np.float32]]:
    """(H, W) disparity of the left image, NaN where the consistency check fails; (H, W) left-right difference, px."""
    height, width = left.shape
    times = -(-width // MATCHING_WIDTH)
    size = (-(-width // times), -(-height // times))
    scale = width / size[0]
    if times > 1:
        left, right = (cv2.resize(camera, size, interpolation=cv2.INTER_AREA) for camera in (left, right))
    bounds = int(np.floor(lowest / scale)), int(np.ceil(highest / scale))
    from_left, from_right = match_both_ways(left, right, *bounds, cfg.block_px)
    apart = disagreement(from_left, from_right)
    from_left[apart > cfg.left_right_px] = np.nan
    if times > 1:
        from_left, apart = (
            cv2.resize(values, (width, height), interpolation=cv2.INTER_NEAREST) for values in (from_left, apart)
        )
        from_left = from_left * np.float32(scale)
    return from_left, apart


def _mean_around(values: NDArray[np.float32], measured: NDArray[np.bool_]) -> NDArray[np.float32]:
    """(H, W) mean of the measured values in a square around each pixel; 0 if there are none."""
    weight = measured.astype(np.float32)
    total = cv2.blur(values * weight, (SURROUNDINGS_PX, SURROUNDINGS_PX))
    share = cv2.blur(weight, (SURROUNDINGS_PX, SURROUNDINGS_PX))
    return np.divide(total, share, out=np.zeros_like(total), where=share > 1e-6)
