"""Whether two images show the same tissue: by corners that are followed, else by features that look alike."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from functools import cached_property
from typing import NamedTuple

import cv2
import numpy as np
from numpy.typing import NDArray

from .components import Image, Mask
from .optical_flow import follow_both_ways

CORNERS, FEATURES = 200, 400  # most corners that are followed, and features that are compared, in an image
FEWEST = 12  # so many points must move together; of images of different places, up to 7 do by chance
SHARE = 0.4  # share of the corners, or of the pairs of features, that must move together
NEAR_PX, LIKE_PX = 2.0, 5.0  # largest distance of a point from where the common motion takes it: corners, features
DISTINCT = 0.8  # a feature is found again if the second best candidate is farther from it by this factor


class View:
    """One small gray image (h, w), see `frame_quality.small_size`, and its features once they are asked for."""

    def __init__(self, gray: Image, inside: Mask | None = None) -> None:
        """Args: inside: (h, w) True where points may lie; None for everywhere."""
        self.gray, self._inside = gray, None if inside is None else inside.astype(np.uint8)

    @cached_property
    def corners(self) -> NDArray[np.float32]:
        """(N, 2) px."""
        found = cv2.goodFeaturesToTrack(self.gray, CORNERS, 0.01, 6, mask=self._inside)
        return np.zeros((0, 2), np.float32) if found is None else np.asarray(found[:, 0], np.float32)

    @cached_property
    def features(self) -> tuple[NDArray[np.float32], NDArray[np.float32]]:
        """(N, 2) px, and what each looks like, (N, 128)."""
        even = cv2.createCLAHE(2.0, (8, 8)).apply(self.gray)  # haze lowers contrast
        points, like = cv2.SIFT.create(FEATURES, contrastThreshold=0.01).detectAndCompute(even, self._inside)
        places = np.array([point.pt for point in points], np.float32).reshape(-1, 2)
        return places, np.zeros((0, 128), np.float32) if like is None else np.asarray(like, np.float32)


class Link(NamedTuple):
    """The common motion from one image to another."""

    shift: float  # mean shift of 9 points spread over the image, as a share of its width
    residual: float  # median distance of the points from where it takes them, as a share of the width
    agreement: float  # share of the points that follow it


def flow_link(before: View, now: View) -> Link | None:
    """The common motion of corners from an image to the next one; None if too few are found again."""
    corners = before.corners
    if len(corners) < FEWEST:
        return None
    there, good = follow_both_ways(before.gray, now.gray, corners, 1.0, side_px=15)
    return _link(corners[good], there[good], len(corners), NEAR_PX, now.gray.shape[1])


def feature_link(before: View, now: View) -> Link | None:
    """The common motion of features between any two images; None if too few are found again."""
    (first, first_like), (second, second_like) = before.features, now.features
    if min(len(first), len(second)) < FEWEST:
        return None
    pairs = [pair for pair in cv2.BFMatcher().knnMatch(first_like, second_like, k=2) if len(pair) == 2]
    found = [best for best, other in pairs if best.distance < DISTINCT * other.distance]
    a, b = first[[match.queryIdx for match in found]], second[[match.trainIdx for match in found]]
    return _link(a, b, len(found), LIKE_PX, now.gray.shape[1])


def _link(a: NDArray[np.float32], b: NDArray[np.float32], of: int, near_px: float, width: int) -> Link | None:
    if len(a) < FEWEST:
        return None
    cv2.setRNGSeed(0)  # RANSAC uses OpenCV's own random generator
    matrix, inliers = cv2.estimateAffinePartial2D(a, b, ransacReprojThreshold=near_px)
    if matrix is None or inliers.sum() < FEWEST or inliers.sum() < SHARE * of:
        return None
    x, y = np.meshgrid(*(np.linspace(side.min(), side.max(), 3) for side in a.T))
    grid = np.stack([x.ravel(), y.ravel()], 1)
    away = np.linalg.norm(a @ matrix[:, :2].T + matrix[:, 2] - b, axis=1)
    shift = np.linalg.norm(grid @ matrix[:, :2].T + matrix[:, 2] - grid, axis=1).mean()
    return Link(float(shift) / width, float(np.median(away)) / width, float(inliers.sum() / of))


def same_view(befores: Iterable[View], afters: Sequence[View]) -> bool:
    """Whether some image before an event and some image after it show the same tissue."""
    return any(feature_link(before, after) is not None for before in befores for after in afters)
