"""Keyframes: descriptors of one frame in some, with which lost or returning frames are recognized (SIFT, Lowe 2004)."""

from __future__ import annotations

from dataclasses import dataclass

import cv2
import numpy as np
from numpy.typing import NDArray

from .corners import sampled
from .resection import coarse_pose
from .residuals import back_projected
from .seen import Lens

KEYPOINTS = 600
RATIO = 0.8
"""The best match is nearer than the second best by this factor (Lowe's ratio test)."""
FEWEST_INLIERS = 20
"""Fewer matches that one pose explains may be chance."""
INLIER_PX = 4.0
"""Reprojection error of a match, px of an image 640 px wide: the tissue may have moved in between."""


@dataclass
class Keyframe:
    """What is kept of a keyframe."""

    frame: int
    pixels: NDArray[np.float32]
    """(M, 2) px."""
    depths: NDArray[np.float32]
    """(M,) mm before any scale, > 0."""
    descriptors: NDArray[np.uint8]
    """(M, 128)."""
    track: NDArray[np.int32]
    """(M,) id of the track of the keypoint, -1 without one."""


@dataclass(frozen=True)
class Link:
    """A keyframe recognized in another one."""

    pose: NDArray[np.float64]
    """(4, 4) world-to-camera of the new one, in the world of the old one."""
    old: NDArray[np.intp]
    """(N,) keypoints of the old one ..."""
    new: NDArray[np.intp]
    """... that are these of the new one."""
    scale: float
    """Depth in the world of the old one, as a multiple of the new one's own depth."""


def keyframe(index: int, gray: NDArray[np.uint8], usable: NDArray[np.bool_], depth: NDArray[np.float32]) -> Keyframe:
    """Describe a frame by its SIFT keypoints on tissue with depth."""
    mask = (usable & (depth > 0)).astype(np.uint8)
    found, descriptors = cv2.SIFT_create(KEYPOINTS, contrastThreshold=0.01).detectAndCompute(gray, mask)
    if descriptors is None:
        found, descriptors = (), np.zeros((0, 128), np.float32)
    pixels = np.array([point.pt for point in found], np.float32).reshape(-1, 2)
    depths = sampled(depth, pixels).astype(np.float32)
    kept = depths > 0
    return Keyframe(
        index, pixels[kept], depths[kept], descriptors[kept].astype(np.uint8), np.full(kept.sum(), -1, np.int32)
    )


def link(lens: Lens, old: Keyframe, old_pose: NDArray, old_scale: float, new: Keyframe) -> Link | None:
    """Find the pose of `new` from what it shares with `old`; None if that is too little."""
    first, second = _matches(old.descriptors, new.descriptors)
    if len(first) < FEWEST_INLIERS:
        return None
    points = back_projected(lens.matrix, old_pose, old.pixels[first], old.depths[first] * old_scale)
    found = coarse_pose(lens.matrix, points, new.pixels[second], None, INLIER_PX * lens.px)
    if found is None or found[1].sum() < max(FEWEST_INLIERS, 0.25 * len(first)):
        return None
    pose, inlier = found
    z = points[inlier] @ pose[2, :3] + pose[2, 3]
    scale = float(np.median(z / new.depths[second[inlier]]))
    if not scale > 0:
        return None
    return Link(pose, first[inlier], second[inlier], scale)


def _matches(first: NDArray[np.uint8], second: NDArray[np.uint8]) -> tuple[NDArray[np.intp], NDArray[np.intp]]:
    """Mutual nearest neighbors that pass the ratio test."""
    if len(first) < 2 or len(second) < 2:
        return np.zeros(0, np.intp), np.zeros(0, np.intp)
    a, b = first.astype(np.float32), second.astype(np.float32)
    distance = (a**2).sum(1)[:, None] + (b**2).sum(1)[None] - 2 * a @ b.T
    best = np.argmin(distance, 1)
    two = np.partition(distance, 1, 1)[:, :2]
    good = (two[:, 0] < RATIO**2 * two[:, 1]) & (np.argmin(distance, 0)[best] == np.arange(len(a)))
    return np.flatnonzero(good), best[good]
