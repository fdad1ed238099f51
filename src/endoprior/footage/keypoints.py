"""SIFT keypoints of an image, and matches of those of two images (D. Lowe, IJCV 2004)."""

from __future__ import annotations

import cv2
import numpy as np
from numpy.typing import NDArray

from .image_operations import Image


def keypoints(
    gray: Image, count: int, inside: NDArray[np.uint8] | None = None, contrast: float = 0.04
) -> tuple[NDArray[np.float32], NDArray[np.float32]]:
    """(N, 2) px of about `count` keypoints at most, and their descriptors (N, 128).

    Args:
        inside: (H, W) not 0 where points may lie; None for everywhere.
        contrast: least one of a point, as OpenCV has it.
    """
    where = np.empty(0, np.uint8) if inside is None else inside
    points, descriptors = cv2.SIFT.create(count, contrastThreshold=contrast).detectAndCompute(gray, where)
    places = np.array([point.pt for point in points], np.float32).reshape(-1, 2)
    return places, np.zeros((0, 128), np.float32) if descriptors is None else np.asarray(descriptors, np.float32)


def match_descriptors(
    first: NDArray[np.float32], second: NDArray[np.float32], ratio: float
) -> tuple[NDArray[np.intp], NDArray[np.intp]]:
    """Rows of descriptors (N, 128) and (M, 128) that match by the ratio test: the best distance is below `ratio` times
    the second best.
    """
    pairs = [pair for pair in cv2.BFMatcher().knnMatch(first, second, k=2) if len(pair) == 2]
    found = [best for best, other in pairs if best.distance < ratio * other.distance]
    return np.array([m.queryIdx for m in found], np.intp), np.array([m.trainIdx for m in found], np.intp)
