"""Burned-in labels and console text: high contrast that stays put while the image changes around it.

Says where such writing lies, not what it says. Faint or changing writing (a running clock) is not found.
"""

from __future__ import annotations

from collections.abc import Sequence

import cv2
import numpy as np
from numpy.typing import NDArray

from ..core.checks import check_shape

LEAST_PICTURES = 5
"""Fewer samples say too little about what stays put."""
LEAST_CONTRAST = 60
"""Levels, 0..255, between ink and ground: writing is made to be read."""
STILL = 0.035
"""Writing varies in time (one standard deviation) by less than this share of its contrast; moving edges by a third."""
STILL_SCENE = 0.3
"""If more than this share of all edges is still, the scene itself stands still and nothing can be said."""
GAP = 0.025
"""Letters closer together than this share of the image's height belong to one label."""
LEAST_PX, MOST_HEIGHT = 7, 0.2
"""Sides of a label: no readable letter is smaller; a share of the image's height, for a block of several lines.
The straight edge of a bar or a console is thinner or longer."""
LINE_ASPECT, BLOCK_SHARE = 1.5, 0.003
"""A line of two letters is this much wider than high; a block covers this share of the image. Resting highlights of a
static camera are neither."""
LEAST_FILL = 0.25
"""Share of a label's rectangle that lies along strokes; on a round border or a resting tool it is far less."""


def find_static_overlays(images: Sequence[NDArray[np.uint8]]) -> list[tuple[int, int, int, int]]:
    """Rectangles around writing that is burned into every image of a clip; words far apart get one each.

    Args:
        images: (H, W, 3) each, 0..255, spread over the clip (about 20); fewer than 5 give no rectangles.
    Returns:
        (x, y, width, height) each, px, with a margin of about half a letter, from top to bottom. Empty where
        the scene itself stands still.
    Raises:
        ValueError: images of unequal shapes.
    """
    if len(images) < LEAST_PICTURES:
        return []
    height, width = images[0].shape[:2]
    total, squares = np.zeros((2, height, width))
    any_edge = np.zeros((height, width), bool)
    for image in images:
        check_shape("first:H,W,3 image:H,W,3", first=images[0], image=image)
        gray = cv2.cvtColor(np.ascontiguousarray(image), cv2.COLOR_RGB2GRAY).astype(np.float64)
        total += gray
        squares += gray * gray
        any_edge |= _contrast(gray) > LEAST_CONTRAST
    mean = total / len(images)
    deviation = np.sqrt(np.maximum(squares / len(images) - mean * mean, 0))
    contrast = _contrast(mean)
    still = (contrast > LEAST_CONTRAST) & (deviation < STILL * contrast)
    if still.sum() > STILL_SCENE * any_edge.sum():
        return []
    gap = max(2, round(GAP * height / 2))
    joined = cv2.morphologyEx(still.astype(np.uint8), cv2.MORPH_CLOSE, np.ones((2 * gap + 1, 2 * gap + 1), np.uint8))
    found = []
    for x, y, w, h, _ in cv2.connectedComponentsWithStats(joined)[2][1:].tolist():
        strokes = still[y : y + h, x : x + w].mean()
        shaped = w >= LINE_ASPECT * h or w * h >= BLOCK_SHARE * width * height
        if min(w, h) >= LEAST_PX and h <= MOST_HEIGHT * height and shaped and strokes >= LEAST_FILL:
            left, top = max(x - gap, 0), max(y - gap, 0)
            found.append((left, top, min(x + w + gap, width) - left, min(y + h + gap, height) - top))
    return sorted(found, key=lambda box: (box[1], box[0]))


def _contrast(gray: NDArray[np.float64]) -> NDArray[np.float64]:
    """(H, W) levels between the brightest and the darkest of the 5x5 px around each pixel."""
    around = np.ones((5, 5), np.uint8)
    return cv2.dilate(gray, around) - cv2.erode(gray, around)
