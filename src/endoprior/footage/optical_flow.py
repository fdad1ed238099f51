"""Dense optical flow between two frames, both ways, by dense inverse search (Kroeger et al. 2016, OpenCV)."""

from __future__ import annotations

import cv2
import numpy as np
from numpy.typing import NDArray

MIN_SIZE_PX = 32
"""Smallest image side that dense inverse search supports."""
MOTION_S = 0.1
"""Time between two frames that show how tissue moves, s: long enough for a breath to move it by a pixel."""
HALVED_FROM_PX = 256
"""Flow of frames with at least this shorter side is computed at half size: four times faster, almost as accurate."""
FINE_SIDE_PX = 256
"""Fine flow is computed on images shrunk by a whole number to at least this shorter side."""

FlowPair = tuple[NDArray[np.float32], NDArray[np.float32]]
"""Flow (h, w, 2) from a frame to the next and back, in px of the image it was computed on."""


def flow_shrink(height: int, width: int) -> int:
    """Divisor of the image size for the flow: 2 for frames of at least `HALVED_FROM_PX`, else 1."""
    return 2 if min(height, width) >= HALVED_FROM_PX else 1


def fine_shrink(height: int, width: int) -> int:
    """Divisor of the image size for fine flow."""
    return max(1, min(height, width) // FINE_SIDE_PX)


def gray_for_flow(rgb_u8: NDArray[np.uint8], shrink: int | None = None) -> NDArray[np.uint8]:
    """(h, w) gray image for the flow, from an (H, W, 3) frame; `shrink` by default that of `flow_shrink`."""
    height, width = rgb_u8.shape[:2]
    shrink = shrink or flow_shrink(height, width)
    gray = cv2.cvtColor(rgb_u8, cv2.COLOR_RGB2GRAY)
    return cv2.resize(gray, (width // shrink, height // shrink), interpolation=cv2.INTER_AREA)


def flow_pair(first: NDArray[np.uint8], second: NDArray[np.uint8]) -> FlowPair:
    """Flow from the first (h, w) gray image to the second, and back; both sides at least `MIN_SIZE_PX`."""
    estimator = _estimator()
    forward = estimator.calc(first, second, None)
    return forward, estimator.calc(second, first, None)


def flow_between(first: NDArray[np.uint8], second: NDArray[np.uint8]) -> NDArray[np.float32]:
    """Flow (h, w, 2) from the first (h, w) gray image to the second; both sides at least `MIN_SIZE_PX`."""
    return _estimator().calc(first, second, None)


def fine_flow(
    first: NDArray[np.uint8], second: NDArray[np.uint8], start: NDArray[np.float32] | None = None
) -> NDArray[np.float32]:
    """Flow as by `flow_between`, but refined on the full image: twice as slow, less than half the error.

    Larger steps between patches and fewer iterations than OpenCV's preset: half the time, the same error.

    Args:
        start: (h, w, 2) a guess to start from, such as the flow to the frame before `second`, px.
    """
    estimator = _estimator()
    estimator.setFinestScale(0)
    estimator.setPatchStride(4)
    estimator.setGradientDescentIterations(12)
    estimator.setVariationalRefinementIterations(2)
    return estimator.calc(first, second, None if start is None else start.copy())


def _estimator() -> cv2.DISOpticalFlow:
    """A new one for each pair: it keeps buffers, and a result must not depend on the previous pair."""
    return cv2.DISOpticalFlow_create(cv2.DISOPTICAL_FLOW_PRESET_MEDIUM)
