"""Optical flow between two images by OpenCV: dense by inverse search (Kroeger et al. 2016), of corners by Lucas and
Kanade with pyramids (Bouguet 2001)."""

# OpenCV's type stubs do not know that a start can be missing.
# pyright: reportCallIssue=false, reportArgumentType=false

from __future__ import annotations

from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

from .image_operations import Image, Mask

MIN_SIZE_PX = 32  # Smallest image side that dense inverse search supports
MOTION_S = 0.1
"""Time between two frames that show how tissue moves, s: long enough for a breath to move it by a pixel."""
HALVED_FROM_PX = 256
"""Flow of frames with at least this shorter side is computed at half size: four times faster, almost as accurate."""
FIXED_IN_IMAGE_PX, FIXED_IN_IMAGE_SHARE = 3.0, 0.3
"""Where the image goes by the first or more, px at a width of 640, a point that goes less than this share is
fixed in the image."""
MAX_FORWARD_BACKWARD_PX = 1.0  # Largest forward-backward error of a corner that counts as followed
FINE_SIDE_PX = 256  # Fine flow is computed on images shrunk by a whole number to at least this shorter side


def flow_shrink(height: int, width: int) -> int:
    """Divisor of the image size for the flow."""
    return 2 if min(height, width) >= HALVED_FROM_PX else 1


def fine_shrink(height: int, width: int) -> int:
    """Divisor of the image size for fine flow."""
    return max(1, min(height, width) // FINE_SIDE_PX)


def gray_for_flow(rgb_u8: Image, shrink: int | None = None) -> Image:
    """(h, w) gray image for the flow, from an (H, W, 3) frame; `shrink` by default that of `flow_shrink`."""
    height, width = rgb_u8.shape[:2]
    shrink = shrink or flow_shrink(height, width)
    gray = cv2.cvtColor(rgb_u8, cv2.COLOR_RGB2GRAY)
    return np.asarray(cv2.resize(gray, (width // shrink, height // shrink), interpolation=cv2.INTER_AREA), np.uint8)


def dense_flow(first: Image, second: Image) -> NDArray[np.float32]:
    """Flow (h, w, 2) from the first (h, w) gray image to the second, px; bit-identical for any number of threads."""
    return _estimator().calc(first, second, None)


def flow_pair(first: Image, second: Image) -> tuple[NDArray[np.float32], NDArray[np.float32]]:
    """`dense_flow` from the first image to the second, and back."""
    estimator = _estimator()
    return estimator.calc(first, second, None), estimator.calc(second, first, None)


def fine_flow(first: Image, second: Image, start: NDArray[np.float32] | None = None) -> NDArray[np.float32]:
    """`dense_flow` refined on the full image: twice as slow, half the error. Larger steps between patches and fewer
    iterations than OpenCV's preset: half the time, the same error. `start` is a guess (h, w, 2), px.
    """
    estimator = _estimator()
    estimator.setFinestScale(0)
    estimator.setPatchStride(4)
    estimator.setGradientDescentIterations(12)
    estimator.setVariationalRefinementIterations(2)
    return estimator.calc(first, second, None if start is None else start.copy())


def _estimator() -> cv2.DISOpticalFlow:
    """A new one for each pair: it keeps buffers, and a result must not depend on the previous pair."""
    return cv2.DISOpticalFlow.create(cv2.DISOPTICAL_FLOW_PRESET_MEDIUM)


def fixed_in_image(way: NDArray, expected: NDArray, width: int) -> Mask:
    """(...) True where a point stays while the scene moves: flow saw the border, the lens or fibers, not tissue.

    Args:
        way: (..., 2) how far flow carries points; NaN is not fixed. expected: (..., 2) how far the scene goes, px.
        width: of the image, px.
    """
    far, gone = np.linalg.norm(expected, axis=-1), np.linalg.norm(way, axis=-1)
    return (far > FIXED_IN_IMAGE_PX * width / 640) & (gone < FIXED_IN_IMAGE_SHARE * far)


def follow_both_ways(
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
        side_px, halvings, guess, criteria: as of `follow_and_return`.
    """
    there, back, found = follow_and_return(
        first, second, pixels, side_px=side_px, halvings=halvings, guess=guess, criteria=criteria
    )
    return there, found & (np.abs(back - pixels).max(1) < max_error_px)


def follow_and_return(
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
