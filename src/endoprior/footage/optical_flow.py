"""Dense optical flow between two images by inverse search (Kroeger et al. 2016), by OpenCV; and what of it differs from
the motion of the tissue as a whole."""

# OpenCV's type stubs do not know that the guess can be missing.
# pyright: reportCallIssue=false, reportArgumentType=false

from __future__ import annotations

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


ROUNDS, EVERY = 8, 7  # rounds of the robust fit of that motion; every so many pixels take part in it


def difference_from_background(flow: NDArray[np.float32], background: Mask) -> tuple[NDArray[np.float32], float]:
    """(h, w) px by which flow (h, w, 2) differs from a smooth motion that explains most of the background (h, w).

    That motion, by a camera or by breathing, is a quadratic function of the place. The second value is the median of
    the difference on the background.
    """
    height, width = background.shape
    y, x = (each.ravel() for each in np.mgrid[:height, :width] / np.array([height, width])[:, None, None] - 0.5)
    terms, moved = np.stack([np.ones_like(x), x, y, x * x, x * y, y * y], 1), flow.reshape(-1, 2)
    some = np.flatnonzero(background)[::EVERY]
    weight, left, coefficients = np.ones(len(some)), np.zeros(len(some)), np.zeros((terms.shape[1], 2))
    for _ in range(ROUNDS):
        weighted = terms[some] * weight[:, None]
        normal = weighted.T @ terms[some] + 1e-6 * np.eye(terms.shape[1])
        coefficients = np.linalg.solve(normal, weighted.T @ moved[some])
        left = np.hypot(*(moved[some] - terms[some] @ coefficients).T)
        weight = 1 / (1 + (left / max(1.5 * np.median(left), 0.1)) ** 2)
    difference = np.hypot(*(moved - terms @ coefficients).T).reshape(height, width)
    return difference.astype(np.float32), float(np.median(left))
