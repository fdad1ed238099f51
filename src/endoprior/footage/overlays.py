"""Detect what was drawn into the images: labels, console text, clocks, boxes around detections. Text is not read.

Labels are static regions of high contrast in a changing image; the digits of a clock may change on a static panel.
Boxes and text of one pure color (red, yellow, green, ...) are found in each image, wherever they are. Faint text, and
gray or white text that moves, is not detected.
"""

from __future__ import annotations

from collections.abc import Sequence
from itertools import pairwise

import cv2
import numpy as np
from numpy.typing import NDArray

from ..core.checks import check_shape
from .components import AREA, Image, Mask, components, grown, regions_where, square

LEAST_IMAGES = 5  # With fewer samples, static text cannot be detected
LEAST_CONTRAST = 60  # Least contrast between text and background, levels 0..255
STATIC = 0.035
"""The standard deviation over time of text is below this share of its contrast; that of moving edges is a third."""
LEAST_FLIPS = 4  # Digits change so often; a tool that enters or leaves changes a pixel once or twice
STATIC_SCENE = 0.3  # If more than this share of all edges is static, the scene is, and no text can be detected
GAP = 0.025  # Letters closer together than this share of the image's height belong to one label
LEAST_PX, MOST_HEIGHT = 7, 0.2
"""Smallest side of a label, px, and its largest height, as a share of the image height. Edges of bars and consoles are
thinner or longer."""
LINE_ASPECT, BLOCK_SHARE = 1.5, 0.003
"""Least aspect ratio of a line of text, or least share of the image for a block. Highlights of a static camera have
neither."""
LEAST_FILL = 0.25  # Least share of the rectangle covered by strokes; on a round border or a static tool it is far less
LEAST_DRAWN = 5.0
"""Strokes are drawn in one color: share of their pixels that have it, times their length in widths. Measured: 7.4 and
more for text, at most 4.1 for highlights."""
SAME_COLOR = 0.15  # Pixels of one color differ by less than this share of the contrast
PURE, BOLD, FAINT = 0.25, 190, 110
"""In a pure color the middle channel is nearer to another than this share of the difference of the extreme ones. That
difference is above `BOLD` somewhere in a stroke, and above `FAINT` everywhere; tissue reaches 160, rarely 190 levels.
"""
DROP, STROKE = 60, 0.004  # That difference falls by so much within the width of a stroke, in sides of the image
LEAST_BOLD, MOST_THICK = 0.2, 0.5  # Shares of a stroke's pixels that are bold, and that are part of something thicker
FILLED = 0.02  # Length from which drawn pixels are filled, in sides of the image
LEAST_STROKES = 0.0005  # Less than this share of the image is coding noise
NEARBY = 3  # Letters closer together than twice this number of stroke widths belong to the same writing


def find_strokes(image: Image) -> Mask:
    """(H, W) True on boxes, lines and text of a pure color that are drawn into one image (H, W, 3)."""
    red, green, blue = (channel.astype(np.int16) for channel in cv2.split(image))
    high, low = np.maximum(np.maximum(red, green), blue), np.minimum(np.minimum(red, green), blue)
    middle, chroma = red + green + blue - high - low, high - low
    if np.count_nonzero(chroma > BOLD) < LEAST_STROKES * chroma.size:
        return np.zeros(chroma.shape, bool)
    width = max(2, round(STROKE * max(chroma.shape)))
    colored = (chroma > FAINT) & (np.minimum(middle - low, high - middle) < PURE * chroma)
    thick = cv2.morphologyEx(colored.astype(np.uint8), cv2.MORPH_OPEN, square(width + 1)) > 0
    regions, boxes = components(colored & (chroma - cv2.erode(chroma, square(width)) > DROP))
    bold, wide = (np.bincount(regions[where], minlength=len(boxes)) for where in (chroma > BOLD, thick))
    thin = wide < MOST_THICK * boxes[:, AREA]
    strokes = regions_where(thin & (bold > LEAST_BOLD * boxes[:, AREA]), regions)
    if strokes.sum() < LEAST_STROKES * strokes.size:
        return np.zeros(chroma.shape, bool)
    # Coding dulls the color of thin letters: they belong to the writing that they stand beside.
    writing, words = components(grown(regions_where(thin, regions), square(NEARBY * width)))
    held = np.bincount(writing[strokes], minlength=len(words)) > 0
    return grown(regions_where(held, writing) & colored | strokes, square(width))


def without_strokes(images: Sequence[Image]) -> list[Image]:
    """The images (H, W, 3), where `find_strokes` finds something with the darkest beside it: a border stays dark."""
    done, reach = [], square(round(FILLED * max(images[0].shape))) if images else square(0)
    for image in images:
        drawn = find_strokes(image)[..., None]
        clear = np.where(drawn, np.uint8(255), image)
        done.append(np.where(drawn, cv2.erode(clear, reach), image) if drawn.any() else image)
    return done


def find_static_overlays(images: Sequence[Image]) -> list[tuple[int, int, int, int]]:
    """Rectangles x, y, width, height, px, around text that is burned into every image of a clip, from top to bottom.

    The images (H, W, 3) are of one size and spread over the clip (about 20). Distant words get separate rectangles,
    with a margin of about half a letter. None for a static scene, or fewer than `LEAST_IMAGES`.
    """
    if len(images) < LEAST_IMAGES:
        return []
    height, width = images[0].shape[:2]
    static, any_edge = _static(images)
    if static.sum() > STATIC_SCENE * any_edge.sum():
        return []
    gap = max(2, round(GAP * height / 2))
    joined = cv2.morphologyEx(static.astype(np.uint8), cv2.MORPH_CLOSE, square(gap)) > 0
    found = []
    for x, y, w, h, _ in components(joined)[1][1:].tolist():
        strokes = static[y : y + h, x : x + w].mean()
        shaped = w >= LINE_ASPECT * h or w * h >= BLOCK_SHARE * width * height
        fits = min(w, h) >= LEAST_PX and h <= MOST_HEIGHT * height and shaped and strokes >= LEAST_FILL
        if fits and _is_drawn(images[len(images) // 2][y : y + h, x : x + w]):
            left, top = max(x - gap, 0), max(y - gap, 0)
            found.append((left, top, min(x + w + gap, width) - left, min(y + h + gap, height) - top))
    return sorted(found, key=lambda box: (box[1], box[0]))


def _static(images: Sequence[Image]) -> tuple[Mask, Mask]:
    """(H, W) True where images have contrast and do not change, or flicker between two values; and where any has it."""
    for image in images:
        check_shape("first:H,W,3 image:H,W,3", first=images[0], image=image)
    grays = [cv2.cvtColor(np.ascontiguousarray(image), cv2.COLOR_RGB2GRAY) for image in images]
    low, high = np.minimum.reduce(grays), np.maximum.reduce(grays)
    between = low / 2.0 + high / 2.0
    flips = sum((now < between) != (then < between) for then, now in pairwise(grays))
    flickers = (high - low > LEAST_CONTRAST) & (flips >= LEAST_FLIPS)
    between[~flickers] = 256
    count, total, squares = np.zeros((2, *low.shape)), np.zeros((2, *low.shape)), np.zeros(low.shape)
    any_edge = np.zeros(low.shape, bool)
    for gray in (each.astype(np.float64) for each in grays):
        for value, where in enumerate((gray < between, gray >= between)):
            count[value] += where
            total[value] += gray * where
        squares += gray * gray
        any_edge |= _contrast(gray) > LEAST_CONTRAST
    deviation = np.sqrt(np.maximum(squares - (total * total / np.maximum(count, 1)).sum(0), 0) / len(images))
    contrast = np.where(flickers, high - low, _contrast(total.sum(0) / len(images)))
    return (contrast > LEAST_CONTRAST) & (deviation < STATIC * contrast), any_edge


def _is_drawn(image: Image) -> bool:
    """Whether writing, bright or dark, fills this part (H, W, 3) of an image: long strokes of one color."""
    gray = image.max(-1).astype(np.float32)
    usual, best = float(np.median(gray)), 0.0
    for sign in (1, -1):
        level = sign * (gray - usual)
        most = float(np.quantile(level, 0.98))
        strokes = level > most / 2
        color = np.median(image[level >= most], axis=0)
        same = np.abs(image - color).max(-1) < SAME_COLOR * most
        outline = sum(np.count_nonzero(np.diff(strokes, axis=axis)) for axis in (0, 1))
        pieces = sum(components(strokes)[1][1:, AREA] >= 4)
        area = max(int(strokes.sum()), 1)
        best = max(best, (same & strokes).sum() / area * outline**2 / (4 * area * max(pieces, 1)))
    return best > LEAST_DRAWN


def _contrast(gray: NDArray[np.float64]) -> NDArray[np.float64]:
    """(H, W) levels between the brightest and the darkest of the 5x5 px around each pixel."""
    return np.asarray(cv2.dilate(gray, square(2)) - cv2.erode(gray, square(2)), np.float64)
