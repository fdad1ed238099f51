"""Black parts inside a round border: where the picture ends before its circle does."""

from __future__ import annotations

from collections.abc import Sequence

import cv2
import numpy as np
from numpy.typing import NDArray

from .circle import Circle
from .dark_outline import brightness, find_darkness, reduced

SHARP_PX = 4
"""A black part ends within this length, px; dark tissue becomes brighter gradually."""
SHARP_SHARE = 0.6
"""Share of its outline on which it does."""
LONG = 3
"""It is this many times longer along the border than deep; a dark tool is not."""
GROW_PX = 3
"""Its outline is blurred by coding: this much more is left out, px."""


def black_arcs(images: Sequence[NDArray[np.uint8]], circle: Circle) -> NDArray[np.bool_]:
    """(H, W) True on black parts of the circle that begin at its border or the image's edge, and end sharply.

    Args:
        images: (H, W, 3) samples; black in all of them.
        circle: its outside is False.
    """
    grays = [cv2.blur(brightness(image), (3, 3)) for image in images]
    height, width = grays[0].shape
    none = np.zeros((height, width), bool)
    darkness = find_darkness(reduced(grays)[0])
    if darkness is None:
        return none
    brightest = np.maximum.reduce(grays)
    beyond = ~circle.mask(width, height, circle.margin_px)
    black = (brightest <= darkness.level + darkness.step) & ~beyond
    black = cv2.morphologyEx(black.astype(np.uint8), cv2.MORPH_OPEN, np.ones((3, 3), np.uint8))
    count, regions = cv2.connectedComponents(black, connectivity=4)
    if count == 1:
        return none
    size = 2 * SHARP_PX + 1
    lit = cv2.dilate(brightest, np.ones((size, size), np.uint8)) > darkness.level + 4 * darkness.step
    edge = (cv2.erode(black, np.ones((3, 3), np.uint8)) == 0) & (black > 0)
    framed = np.pad((~beyond).astype(np.uint8), 1)  # the edge of the image cuts the circle
    distance = cv2.distanceTransform(framed, cv2.DIST_L2, cv2.DIST_MASK_PRECISE)[1:-1, 1:-1]
    inner = edge & (distance > SHARP_PX)
    depth = np.zeros(count, np.float32)
    np.maximum.at(depth, regions[black > 0], distance[black > 0])
    contact = np.bincount(regions[(black > 0) & (distance < 1.5)], minlength=count)
    outline = np.bincount(regions[inner], minlength=count)
    sharp = np.bincount(regions[inner & lit], minlength=count)
    chosen = (contact > LONG * depth) & (outline > 0) & (sharp >= SHARP_SHARE * outline)
    chosen[0] = False
    grown = cv2.dilate(chosen[regions].astype(np.uint8), np.ones((2 * GROW_PX + 1,) * 2, np.uint8)) > 0
    return grown & ~beyond
