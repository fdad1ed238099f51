"""The black margin that rectification leaves around an image: no color at all, in every image, up to the edge."""

from __future__ import annotations

from collections.abc import Sequence

import cv2
import numpy as np
from numpy.typing import NDArray

from .dark_outline import brightness, find_darkness

BLACKEST = 20
"""A margin is darker than this level, 0..255; unlit tissue rarely is in every image."""
SHARP_PX = 4
"""The image begins within this length, px; dark tissue becomes brighter gradually."""
SHARP_SHARE = 0.3
"""Share of the margin's inner outline on which it does."""
LEAST_SHARE = 0.001
"""Smaller regions, as a share of the image, are no margin."""
GROW_PX = 2
"""Interpolation and coding darken or blur so many more pixels next to it."""
FRAME_PX = 3
"""Width of the frame that is put around the image meanwhile."""


def black_margin(images: Sequence[NDArray[np.uint8]]) -> NDArray[np.bool_]:
    """(H, W) True on regions that are black in all images, touch the image's edge and end sharply.

    Args:
        images: (H, W, 3) samples of one clip at different times.
    """
    # A black frame around the image joins the regions of its sides, and keeps narrow ones.
    grays = [cv2.copyMakeBorder(brightness(image), *4 * (FRAME_PX,), cv2.BORDER_CONSTANT) for image in images]
    grays = [cv2.blur(gray, (3, 3)) for gray in grays]
    inner = (slice(FRAME_PX, -FRAME_PX),) * 2
    brightest = np.maximum.reduce(grays)
    darkness = find_darkness([gray[inner] for gray in grays])
    none = np.zeros(brightest[inner].shape, bool)
    if darkness is None or darkness.level >= BLACKEST:
        return none
    black = (brightest <= darkness.level + darkness.step).astype(np.uint8)
    kernel = np.ones((3, 3), np.uint8)
    _, regions = cv2.connectedComponents(cv2.morphologyEx(black, cv2.MORPH_OPEN, kernel), connectivity=4)
    margin = (regions == regions[0, 0]).astype(np.uint8)
    if margin[inner].mean() < LEAST_SHARE:
        return none
    outline = ((cv2.dilate(margin, kernel) > margin)[inner]).nonzero()
    around = np.ones((2 * SHARP_PX + 1,) * 2, np.uint8)
    lit = (cv2.dilate(brightest, around) > darkness.level + 4 * darkness.step)[inner]
    if not len(outline[0]) or lit[outline].mean() < SHARP_SHARE:
        return none
    return cv2.dilate(margin[inner], np.ones((2 * GROW_PX + 1,) * 2, np.uint8)) > 0
