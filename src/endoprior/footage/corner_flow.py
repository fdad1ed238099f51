"""Corners followed from one image to another and back, by the pyramidal method of Lucas and Kanade (Bouguet 2001)."""

from __future__ import annotations

from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray


def follow_both_ways(
    first: NDArray[np.uint8],
    second: NDArray[np.uint8],
    pixels: NDArray[np.float32],
    return_px: float,
    *,
    side_px: int = 21,
    halvings: int = 3,
    guess: NDArray[np.float32] | None = None,
    criteria: tuple[int, int, float] | None = None,
) -> tuple[NDArray[np.float32], NDArray[np.bool_]]:
    """Where the second image shows pixels of the first, and which of them the way back leads home.

    Args:
        first, second: (H, W) gray images.
        pixels: (N, 2) px, N > 0; pixel centers count from 0.
        return_px: followed back, x and y of a pixel come back within this distance, or it counts as lost.
        side_px: side of the window that is compared.
        halvings: how often the images are halved; it bounds the motion that is found.
        guess: (N, 2) where to start in the second image; without it at `pixels`.
        criteria: when the iteration ends, as OpenCV has it; None for its default.
    Returns:
        (N, 2) pixels of the second image, meaningless where lost, and (N,) False where lost.
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
    kept = (found & found_back).ravel().astype(bool) & (np.abs(back - pixels).max(1) < return_px)
    return there, kept
