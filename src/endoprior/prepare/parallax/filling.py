"""The guess bent to the measured depth, where it says how depth goes on from what is measured; and steady over time.

What the logarithm of the depth lacks at confident pixels is spread over their neighborhood by successive corrections
(Barnes 1964), from wide to narrow; what is left is added where it was measured.
"""

from __future__ import annotations

from collections.abc import Sequence

import cv2
import numpy as np
from numpy.typing import NDArray

from ..camera_path.even_view import Warp

REACHES = (1 / 3, 1 / 6, 1 / 12, 1 / 24, 1 / 48, 1 / 96)  # standard deviations, as shares of the width
DOUBT = 0.05  # weight of no change beside that of pixels that are sure
LEAST = 0.1  # confidence below which a pixel does not speak
SAME = 0.1  # difference of log depth that halves the weight of another frame: beyond, it shows another surface
MOST_RATIO = 3.0  # of a measured depth to the guess, after one factor for the frame; beyond, it is a match by chance


def bent(
    guess: NDArray[np.float32], inverse: NDArray[np.float32], confidence: NDArray[np.float32]
) -> NDArray[np.float32]:
    """(h, w) factor that brings a guessed depth to the measured one.

    Args:
        guess: (h, w) depth, 0 where it is missing. inverse: (h, w) measured inverse depth.
        confidence: (h, w) of what was measured, in [0, 1].
    """
    weight = np.where((guess > 0) & (confidence > LEAST), confidence**2, 0).astype(np.float32)
    left = -np.log(np.maximum(inverse * np.where(guess > 0, guess, 1), np.float32(1e-6))).astype(np.float32)
    field = np.full_like(left, _median(left, weight))
    left = np.clip(left - field, -np.log(MOST_RATIO), np.log(MOST_RATIO)).astype(np.float32)
    for reach in REACHES:
        sigma = reach * guess.shape[1]
        spread = cv2.GaussianBlur(left * weight, (0, 0), sigma) / (cv2.GaussianBlur(weight, (0, 0), sigma) + DOUBT)
        field, left = field + spread, left - spread
    return np.exp(field)


def steady(
    depth: NDArray[np.float32], warps: Sequence[Warp], others: Sequence[NDArray[np.float32]]
) -> NDArray[np.float32]:
    """(h, w) depth of a frame, averaged with what frames around it have there: noise of single frames would shake it.

    Args:
        depth: (h, w), 0 where it is missing. warps, others: to each frame around it, and (h, w) its depth.
    """
    inverse = np.reciprocal(np.maximum(depth, np.float32(1e-6)))
    total, weight = np.zeros_like(depth), np.ones_like(depth)
    for warp, other in zip(warps, others, strict=True):
        x, y, expected = warp.at(inverse)
        seen = cv2.remap(other, x, y, cv2.INTER_LINEAR, borderMode=cv2.BORDER_CONSTANT, borderValue=0)
        change = np.log(np.maximum(seen * expected, np.float32(1e-6)))
        agrees = np.where(seen > 0, 1 / (1 + (change / np.float32(SAME)) ** 2), 0)
        total += agrees * change
        weight += agrees
    return depth * np.exp(total / weight)


def _median(values: NDArray, weight: NDArray) -> float:
    """Weighted median; 0 without any weight."""
    order = np.argsort(values, axis=None)
    share = np.cumsum(weight.ravel()[order], dtype=np.float64)
    return float(values.flat[order[np.searchsorted(share, share[-1] / 2)]]) if share[-1] > 0 else 0.0
