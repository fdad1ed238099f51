"""Detect camera motion. Tissue moves locally and returns; a moving camera shifts, rotates or zooms the whole image."""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass
from itertools import repeat

import cv2
import numpy as np
from numpy.typing import NDArray

from .components import Image, Mask
from .optical_flow import follow_both_ways

WORK_WIDTH = 320  # Images are resized to this width, px: enough for hundreds of corners, and fast
MAX_CORNERS = 400
MIN_TRACKS = 24  # With fewer tracked corners, no motion is estimated for a pair of images
RETURN_PX = 1.0  # Followed to the next image and back, a corner returns within this distance
MIN_INLIERS = 0.4  # Share of corners that must be inliers; below, camera motion does not explain the pair
MOVING_FRACTION = 0.06
"""The camera moves if the whole image shifts by more than this share of its width. Breathing shifts it by 3 %."""


@dataclass(frozen=True)
class CameraMotion:
    """Motion of the image as a whole."""

    pixels_per_frame: NDArray[np.float64]
    """(K - 1,) mean shift between successive images, px of the given images; NaN where no motion fits."""
    path_px: NDArray[np.float64]
    """(K,) shift of the whole image from the first one, px; unexplained steps count as 0."""
    moving: bool  # Whether the camera moves
    reason: str  # The measurements in one line


def camera_motion(images: Iterable[Image], tissue_masks: Iterable[Mask] | None = None) -> CameraMotion:
    """Track corners between successive images, and chain the similarity transforms fitted by RANSAC. Of the K images
    (H, W, 3) only two are in memory at a time. Corners are allowed where the masks (H, W) are True; None allows all.
    """
    shifts, path = [], [0.0]
    chain, before, size, factor = np.eye(3), None, (1, 1), 1.0
    for image, mask in zip(images, repeat(None) if tissue_masks is None else tissue_masks, strict=False):
        factor = min(1.0, WORK_WIDTH / image.shape[1])
        fy = max(factor, 1 / image.shape[0])  # a strip keeps its one row
        gray = cv2.cvtColor(image, cv2.COLOR_RGB2GRAY)
        gray = np.asarray(cv2.resize(gray, None, fx=factor, fy=fy, interpolation=cv2.INTER_AREA), np.uint8)
        size, allowed = gray.shape[::-1], None
        if mask is not None:
            allowed = cv2.resize(mask.astype(np.uint8), size, interpolation=cv2.INTER_NEAREST)
            allowed = np.asarray(cv2.erode(allowed, np.ones((5, 5))), np.uint8)
        if before is not None:
            step = _step(*before, gray)
            shifts.append(np.nan if step is None else _mean_shift(step, *size) / factor)
            chain = chain if step is None else step @ chain
            path.append(_mean_shift(chain, *size) / factor)
        before = (gray, allowed)
    steps, distances = np.array(shifts), np.array(path)
    farthest, known = distances.max(), np.isfinite(steps)
    reason = (
        f"the whole image shifts by up to {farthest:.0f} px from the first frame "
        f"({np.median(steps[known]) if known.any() else 0:.1f} px a step; "
        f"{known.mean() if len(steps) else 1.0:.0%} of steps explained)"
    )
    return CameraMotion(steps, distances, bool(farthest > MOVING_FRACTION * size[0] / factor), reason)


def _step(before: Image, allowed: Image | None, now: Image) -> NDArray | None:
    """(3, 3) similarity transform between two small gray images; None if too few corners are inliers."""
    found = cv2.goodFeaturesToTrack(before, MAX_CORNERS, 0.01, 5, mask=allowed)
    if found is None or len(found) < MIN_TRACKS:
        return None
    corners = np.asarray(found[:, 0], np.float32)
    there, good = follow_both_ways(before, now, corners, RETURN_PX, side_px=15)
    if good.sum() < MIN_TRACKS:
        return None
    cv2.setRNGSeed(0)  # RANSAC uses OpenCV's own random generator
    matrix, inliers = cv2.estimateAffinePartial2D(corners[good], there[good], ransacReprojThreshold=1.5)
    return None if matrix is None or inliers.mean() < MIN_INLIERS else np.vstack([matrix, [0, 0, 1]])


def _mean_shift(matrix: NDArray, width: int, height: int) -> float:
    """Mean shift by a (3, 3) transform of 9 points spread over the image, px; also a zoom moves most of them."""
    x, y = np.meshgrid(np.array([1, 3, 5]) * width / 6, np.array([1, 3, 5]) * height / 6)
    grid = np.stack([x.ravel(), y.ravel()], 1)
    return float(np.hypot(*(grid @ matrix[:2, :2].T + matrix[:2, 2] - grid).T).mean())
