"""Does the camera move? Tissue moves in places and comes back; a moving camera shifts, turns or zooms everything."""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass

import cv2
import numpy as np
from numpy.typing import NDArray

WORK_WIDTH = 320
"""Images are brought to this width, px: enough for hundreds of corners, quick to follow."""
MAX_CORNERS = 400
MIN_TRACKS = 24
"""Fewer followed corners say nothing about a pair of images."""
MIN_INLIERS = 0.4
"""Share of corners that must agree on one motion; below, the pair is not explained by the camera."""
MOVING_FRACTION = 0.06
"""The camera moves if the image as a whole ends up or passes farther away than this share of its width.
Breathing shifts it by 3 % and back."""


@dataclass(frozen=True)
class CameraMotion:
    """Motion of the image as a whole."""

    pixels_per_frame: NDArray[np.float64]
    """(K - 1,) mean shift of the image from each to the next, px of the given images; NaN where nothing agrees."""
    path_px: NDArray[np.float64]
    """(K,) how far the image as a whole has come from the first one, px, unexplained steps counted as none."""
    moving: bool
    """Whether a camera that stands still is implausible."""
    reason: str
    """One line."""


def camera_motion(
    images: Iterable[NDArray[np.uint8]], tissue_masks: Iterable[NDArray[np.bool_]] | None = None
) -> CameraMotion:
    """Follow corners from image to image and chain the similarity transforms that most of them agree on.

    Args:
        images: K of (H, W, 3), in order; only two are held at a time.
        tissue_masks: (H, W) each, True where corners may lie; None allows all.
    """
    shifts, path = [], [0.0]
    chain, before, size, factor = np.eye(3), None, (1, 1), 1.0
    masks = iter(tissue_masks) if tissue_masks is not None else None
    for image in images:
        factor = min(1.0, WORK_WIDTH / image.shape[1])
        gray = cv2.cvtColor(image, cv2.COLOR_RGB2GRAY)
        fy = max(factor, 1 / gray.shape[0])  # a strip keeps its one row
        gray = cv2.resize(gray, None, fx=factor, fy=fy, interpolation=cv2.INTER_AREA)
        allowed = None
        if masks is not None:
            mask = next(masks).astype(np.uint8)
            allowed = cv2.erode(cv2.resize(mask, gray.shape[::-1], interpolation=cv2.INTER_NEAREST), np.ones((5, 5)))
        size = gray.shape[::-1]
        if before is not None:
            step = _step(*before, gray)
            grid = _grid(*size)
            if step is None:
                shifts.append(np.nan)
            else:
                shifts.append(float(np.hypot(*(_apply(step, grid) - grid).T).mean()) / factor)
                chain = step @ chain
            path.append(float(np.hypot(*(_apply(chain, grid) - grid).T).mean()) / factor)
        before = (gray, allowed)
    steps, distances = np.array(shifts), np.array(path)
    farthest = distances.max() if len(distances) else 0.0
    moving = bool(farthest > MOVING_FRACTION * size[0] / factor)
    explained = float(np.isfinite(steps).mean()) if len(steps) else 1.0
    reason = (
        f"the image as a whole comes up to {farthest:.0f} px away from the first frame "
        f"({np.nanmedian(steps) if np.isfinite(steps).any() else 0:.1f} px a step; {explained:.0%} of steps explained)"
    )
    return CameraMotion(steps, distances, moving, reason)


def _step(before: NDArray[np.uint8], allowed: NDArray[np.uint8] | None, now: NDArray[np.uint8]) -> NDArray | None:
    """(3, 3) similarity from one small gray image to the next, None if corners do not agree on one."""
    corners = cv2.goodFeaturesToTrack(before, MAX_CORNERS, 0.01, 5, mask=allowed)
    if corners is None or len(corners) < MIN_TRACKS:
        return None
    there, found, _ = cv2.calcOpticalFlowPyrLK(before, now, corners, None, winSize=(15, 15), maxLevel=3)
    back, found_back, _ = cv2.calcOpticalFlowPyrLK(now, before, there, None, winSize=(15, 15), maxLevel=3)
    good = (found & found_back).ravel().astype(bool) & (np.abs(back - corners).max((1, 2)) < 1)
    if good.sum() < MIN_TRACKS:
        return None
    cv2.setRNGSeed(0)  # RANSAC draws from OpenCV's own generator
    matrix, inliers = cv2.estimateAffinePartial2D(corners[good], there[good], ransacReprojThreshold=1.5)
    if matrix is None or inliers.mean() < MIN_INLIERS:
        return None
    return np.vstack([matrix, [0, 0, 1]])


def _grid(width: int, height: int) -> NDArray[np.float64]:
    """(9, 2) points all over the image: a zoom about the center moves most of them."""
    x, y = np.meshgrid(np.array([1, 3, 5]) * width / 6, np.array([1, 3, 5]) * height / 6)
    return np.stack([x.ravel(), y.ravel()], 1)


def _apply(matrix: NDArray, points: NDArray) -> NDArray[np.float64]:
    return points @ matrix[:2, :2].T + matrix[:2, 2]
