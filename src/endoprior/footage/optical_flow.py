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
"""Frames with at least this shorter side are tracked at half size: four times faster, almost as accurate."""
RETURN_PX, RETURN_SHARE = 1.0, 0.05
"""A point is lost where forward and backward flow disagree by more than this, plus this share of the step."""
FLOW_BYTES = 40
"""Memory per pixel while the flow of a pair of frames is computed, bytes."""

FlowPair = tuple[NDArray[np.float32], NDArray[np.float32]]
"""Flow (h, w, 2) from a frame to the next and back, in px of the image it was computed on."""


def flow_shrink(height: int, width: int) -> int:
    """Divisor of the image size for the flow: 2 for frames of at least `HALVED_FROM_PX`, else 1."""
    return 2 if min(height, width) >= HALVED_FROM_PX else 1


def gray_for_flow(rgb_u8: NDArray[np.uint8]) -> NDArray[np.uint8]:
    """(h, w) gray image at the size at which the flow is computed, from an (H, W, 3) frame."""
    height, width = rgb_u8.shape[:2]
    shrink = flow_shrink(height, width)
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


def _estimator() -> cv2.DISOpticalFlow:
    """A new one for each pair: it keeps buffers, and a result must not depend on the previous pair."""
    return cv2.DISOpticalFlow_create(cv2.DISOPTICAL_FLOW_PRESET_MEDIUM)
