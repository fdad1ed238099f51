"""Detect drawings of one pure color (red, yellow, green, ...) in single images: boxes, lines, and text in them.

A detection system draws them, and they move. Text of any color is found by `texts`.
"""

from __future__ import annotations

from collections.abc import Sequence

import cv2
import numpy as np

from .image_operations import AREA, Image, Mask, components, dilated, regions_where, square

PURE, BOLD, FAINT = 0.25, 190, 110
"""In a pure color the middle channel is nearer to another than this share of the difference of the extreme ones. That
difference is above `BOLD` somewhere in a stroke, and above `FAINT` everywhere; tissue reaches 160, rarely 190 levels.
"""
DROP, STROKE = 60, 0.004  # That difference falls by so much within the width of a stroke, in sides of the image
MIN_BOLD, MAX_THICK = 0.2, 0.5  # Shares of a stroke's pixels that are bold, and that are part of something thicker
FILLED = 0.02  # Length from which drawn pixels are filled, in sides of the image
MIN_STROKES = 0.0005  # Less than this share of the image is coding noise
NEARBY = 3  # Letters closer together than twice this number of stroke widths belong to the same writing


def find_strokes(image: Image) -> Mask:
    """(H, W) True on boxes, lines and text of a pure color that are drawn into one image (H, W, 3)."""
    red, green, blue = (channel.astype(np.int16) for channel in cv2.split(image))
    high, low = np.maximum(np.maximum(red, green), blue), np.minimum(np.minimum(red, green), blue)
    middle, chroma = red + green + blue - high - low, high - low
    if np.count_nonzero(chroma > BOLD) < MIN_STROKES * chroma.size:
        return np.zeros(chroma.shape, bool)
    width = max(2, round(STROKE * max(chroma.shape)))
    colored = (chroma > FAINT) & (np.minimum(middle - low, high - middle) < PURE * chroma)
    thick = cv2.morphologyEx(colored.astype(np.uint8), cv2.MORPH_OPEN, square(width + 1)) > 0
    regions, boxes = components(colored & (chroma - cv2.erode(chroma, square(width)) > DROP))
    bold, wide = (np.bincount(regions[where], minlength=len(boxes)) for where in (chroma > BOLD, thick))
    thin = wide < MAX_THICK * boxes[:, AREA]
    strokes = regions_where(thin & (bold > MIN_BOLD * boxes[:, AREA]), regions)
    if strokes.sum() < MIN_STROKES * strokes.size:
        return np.zeros(chroma.shape, bool)
    # Coding dulls the color of thin letters: they belong to the writing that they stand beside.
    writing, words = components(dilated(regions_where(thin, regions), square(NEARBY * width)))
    held = np.bincount(writing[strokes], minlength=len(words)) > 0
    return dilated(regions_where(held, writing) & colored | strokes, square(width))


def without_strokes(images: Sequence[Image]) -> list[Image]:
    """The images (H, W, 3), where `find_strokes` finds something with the darkest beside it: a border stays dark."""
    done, reach = [], square(round(FILLED * max(images[0].shape))) if images else square(0)
    for image in images:
        drawn = find_strokes(image)[..., None]
        clear = np.where(drawn, np.uint8(255), image)
        done.append(np.where(drawn, cv2.erode(clear, reach), image) if drawn.any() else image)
    return done
