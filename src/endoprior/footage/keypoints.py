"""Keypoints in two images by OpenCV: SIFT and its matches (D. Lowe, IJCV 2004), and points that are followed by Lucas
and Kanade with pyramids (Bouguet 2001)."""

# OpenCV's type stubs do not know that a start can be missing.
# pyright: reportCallIssue=false, reportArgumentType=false

from __future__ import annotations

from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

from .image_operations import Image, Mask

MAX_FORWARD_BACKWARD_PX = 1.0  # Largest forward-backward error of a point that counts as followed


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


def track_points(
    first: Image,
    second: Image,
    pixels: NDArray[np.float32],
    *,
    max_error_px: float = MAX_FORWARD_BACKWARD_PX,
    side_px: int = 21,
    halvings: int = 3,
    guess: NDArray[np.float32] | None = None,
    criteria: tuple[int, int, float] | None = None,
) -> tuple[NDArray[np.float32], Mask]:
    """Where the second gray image shows pixels (N, 2) of the first, and (N,) False where the way back leads elsewhere.

    Args:
        max_error_px: largest forward-backward error of x and of y, px; above it a pixel counts as lost.
        side_px, halvings, guess, criteria: as of `track_forward_backward`.
    """
    there, back, found = track_forward_backward(
        first, second, pixels, side_px=side_px, halvings=halvings, guess=guess, criteria=criteria
    )
    return there, found & (np.abs(back - pixels).max(1) < max_error_px)


def track_forward_backward(
    first: Image,
    second: Image,
    pixels: NDArray[np.float32],
    *,
    side_px: int,
    halvings: int,
    guess: NDArray[np.float32] | None = None,
    criteria: tuple[int, int, float] | None = None,
) -> tuple[NDArray[np.float32], NDArray[np.float32], Mask]:
    """Where the second gray image shows pixels (N, 2) of the first, where the way back leads, and (N,) if both exist.

    Args:
        side_px: side of the window that is compared.
        halvings: how often the images are halved; it bounds the motion that is found.
        guess: (N, 2) where to start in the second image; without it at `pixels`.
        criteria: when the iteration ends, as OpenCV has it; None for its default.
    """
    options: dict[str, Any] = {"winSize": (side_px, side_px), "maxLevel": halvings}
    if criteria is not None:
        options["criteria"] = criteria
    if guess is not None:
        options["flags"] = cv2.OPTFLOW_USE_INITIAL_FLOW
    start = None if guess is None else guess.copy()  # OpenCV overwrites it
    there, found, _ = cv2.calcOpticalFlowPyrLK(first, second, pixels, start, **options)
    home = None if guess is None else pixels + there - guess
    back, found_back, _ = cv2.calcOpticalFlowPyrLK(second, first, there, home, **options)
    return there, back, (found & found_back).ravel().astype(bool)
