"""The guess bent to the measured depth: where nothing is measured, it says how depth goes on from where it is.

What the logarithm of the depth lacks at confident pixels is spread over their neighborhood by successive corrections
(Barnes 1964), from wide to narrow; what is left is added where it was measured.
"""

from __future__ import annotations

import cv2
import numpy as np
from numpy.typing import NDArray

REACHES = (1 / 3, 1 / 6, 1 / 12, 1 / 24, 1 / 48, 1 / 96)  # standard deviations, as shares of the width
DOUBT = 0.05  # weight of no change beside that of pixels that are sure
LEAST = 0.1  # confidence below which a pixel does not speak
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


def _median(values: NDArray, weight: NDArray) -> float:
    """Weighted median; 0 without any weight."""
    order = np.argsort(values, axis=None)
    share = np.cumsum(weight.ravel()[order], dtype=np.float64)
    return float(values.flat[order[np.searchsorted(share, share[-1] / 2)]]) if share[-1] > 0 else 0.0
