"""Detect burned-in labels and console text: static regions of high contrast in a changing image. The text itself is not
read. Faint or changing text (a running clock) is not detected.
"""

from __future__ import annotations

from collections.abc import Sequence

import cv2
import numpy as np
from numpy.typing import NDArray

from ..core.checks import check_shape
from .components import Image, components, square

LEAST_IMAGES = 5  # With fewer samples, static text cannot be detected
LEAST_CONTRAST = 60  # Least contrast between text and background, levels 0..255
STATIC = 0.035
"""The standard deviation over time of text is below this share of its contrast; that of moving edges is a third."""
STATIC_SCENE = 0.3  # If more than this share of all edges is static, the scene is, and no text can be detected
GAP = 0.025  # Letters closer together than this share of the image's height belong to one label
LEAST_PX, MOST_HEIGHT = 7, 0.2
"""Smallest side of a label, px, and its largest height, as a share of the image height. Edges of bars and consoles are
thinner or longer."""
LINE_ASPECT, BLOCK_SHARE = 1.5, 0.003
"""Least aspect ratio of a line of text, or least share of the image for a block. Highlights of a static camera have
neither."""
LEAST_FILL = 0.25  # Least share of the rectangle covered by strokes; on a round border or a static tool it is far less


def find_static_overlays(images: Sequence[Image]) -> list[tuple[int, int, int, int]]:
    """Rectangles x, y, width, height, px, around text that is burned into every image of a clip, from top to bottom.

    The images (H, W, 3) are of one size and spread over the clip (about 20). Distant words get separate rectangles,
    with a margin of about half a letter. None for a static scene, or fewer than `LEAST_IMAGES`.
    """
    if len(images) < LEAST_IMAGES:
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
    static = (contrast > LEAST_CONTRAST) & (deviation < STATIC * contrast)
    if static.sum() > STATIC_SCENE * any_edge.sum():
        return []
    gap = max(2, round(GAP * height / 2))
    joined = cv2.morphologyEx(static.astype(np.uint8), cv2.MORPH_CLOSE, square(gap)) > 0
    found = []
    for x, y, w, h, _ in components(joined)[1][1:].tolist():
        strokes = static[y : y + h, x : x + w].mean()
        shaped = w >= LINE_ASPECT * h or w * h >= BLOCK_SHARE * width * height
        if min(w, h) >= LEAST_PX and h <= MOST_HEIGHT * height and shaped and strokes >= LEAST_FILL:
            left, top = max(x - gap, 0), max(y - gap, 0)
            found.append((left, top, min(x + w + gap, width) - left, min(y + h + gap, height) - top))
    return sorted(found, key=lambda box: (box[1], box[0]))


def _contrast(gray: NDArray[np.float64]) -> NDArray[np.float64]:
    """(H, W) levels between the brightest and the darkest of the 5x5 px around each pixel."""
    return np.asarray(cv2.dilate(gray, square(2)) - cv2.erode(gray, square(2)), np.float64)
