"""Where the endoscope image ends: strips at the sides, a circle, and borders of any other shape. Images are K samples
of the clip, (H, W, 3), at different times.
"""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from dataclasses import dataclass

import cv2
import numpy as np
from numpy.typing import NDArray

from .components import Image, Mask
from .dark_outline import Circle, brightness
from .outside import Outside, find_outside
from .round_border import find_circle

__all__ = ["Circle", "Outline", "Outside", "Strips", "find_circle", "find_outline", "find_strips", "masked_border"]

BLACK_LEVEL = 28  # Levels 0..255 below this are black, including limited-range video with coding noise
MIN_STRIP_PX = 3  # Thinner strips are ignored; they can be coding noise
MAX_STRIP_FRACTION = 0.25  # Largest share of the image for one strip
STATIC_RATIO = 0.3  # The change over time of a strip is below this share of the change in the image center ...
STRIP_CHROMA = 40  # ... and a strip is gray: the channels of half of its pixels differ by less than this.
EDGE_SHARE, EDGE_STEP = 0.55, 12
"""Share of a strip's edge with a brightness step, and its least levels: unlike that of a shadow, it is straight."""
FADING, MOST_FADING_PX = 0.8, 3
"""So many rows next to a strip belong to it if they have less than this share of the level two rows further inside."""


@dataclass(frozen=True)
class Strips:
    """Rows and columns at each side that are outside of the endoscope image, px."""

    top: int
    bottom: int
    left: int
    right: int

    def __bool__(self) -> bool:
        return any((self.top, self.bottom, self.left, self.right))


@dataclass(frozen=True)
class Outline:
    """Where the endoscope image ends, judging by the images alone."""

    strips: Strips
    circle: Circle | None
    in_strip: Mask  # (H, W) True in the strips
    other: Outside  # what else is outside: a border that is no circle, or black parts inside of the circle
    outside: Mask  # (H, W) True outside of the circle, on its rim, and on `other`

    @property
    def found(self) -> bool:
        """Whether the endoscope image ends before the frame does."""
        return bool(self.strips or self.outside.any())


def find_outline(images: Sequence[Image]) -> Outline:
    """Detect strips and a border of any shape in (H, W, 3) sample images."""
    height, width = images[0].shape[:2]
    circle = find_circle(images)
    strips = find_strips(images, circle)
    in_strip = np.ones((height, width), bool)
    in_strip[strips.top : height - strips.bottom, strips.left : width - strips.right] = False
    inside = circle.mask(width, height, circle.margin_px) if circle else np.ones((height, width), bool)
    other = find_outside(images, inside & ~in_strip)
    return Outline(strips, circle, in_strip, other, ~inside | other.mask)


def masked_border(outline: Outline, images: Sequence[Image], tissue_masks: Iterable[Mask]) -> Mask:
    """(H, W) True where no frame is tissue, and no sample image shows anything: black, or beyond the outline."""
    masked = outline.in_strip | outline.outside | (np.maximum.reduce(images).max(-1) < BLACK_LEVEL)
    for tissue in tissue_masks:
        masked &= ~tissue
    return masked


def find_strips(images: Sequence[Image], circle: Circle | None = None) -> Strips:
    """Detect black bars and static gray console strips at the sides; of a single image only black bars. What lies
    outside of the circle is no strip and hides none.
    """
    grays = [cv2.cvtColor(image, cv2.COLOR_RGB2GRAY).astype(np.float32) for image in images]
    mean = sum(grays) / len(grays)
    change = np.sqrt(sum((gray - mean) ** 2 for gray in grays) / len(grays))
    chroma = sum((brightness(image) - ~brightness(~image)).astype(np.float32) for image in images) / len(images)
    brightest = np.maximum.reduce([brightness(image) for image in images])
    height, width = brightest.shape
    central_change = float(np.median(change[height // 4 : height - height // 4, width // 4 : width - width // 4]))
    inside = circle.mask(width, height, circle.margin_px) if circle else np.ones((height, width), bool)
    maps = brightest, chroma, change, mean, inside
    top, bottom, right, left = (  # turned so that the side in question is on top
        _strip_on_top([np.rot90(each, turns) for each in maps], central_change) for turns in (0, 2, 1, 3)
    )
    return Strips(top, bottom, left, right)


def _strip_on_top(maps: list[NDArray], central_change: float) -> int:
    """Number of rows of a strip at the top of these (H, W) maps, 0 for none."""
    brightest, chroma, change, mean, inside = maps
    limit = int(MAX_STRIP_FRACTION * len(brightest))
    first = int(inside.any(1).argmax())  # rows above show nothing of the circle
    rows = first
    while rows <= limit:
        at = inside[rows]
        black = np.quantile(brightest[rows][at], 0.98) < BLACK_LEVEL
        static = np.quantile(change[rows][at], 0.8) < STATIC_RATIO * central_change  # False for one image
        if not (black or (static and np.median(chroma[rows][at]) < STRIP_CHROMA)):
            break
        rows += 1
    if rows < MIN_STRIP_PX or rows == first or rows > limit:
        return 0
    # A row of coding noise can lie between strip and image.
    jumps = [
        np.abs(mean[row] - mean[rows - 1])[inside[rows - 1] & inside[row]] > EDGE_STEP
        for row in range(rows, min(rows + 2, len(mean)))
    ]
    if max((jump.mean() for jump in jumps if jump.size), default=0.0) <= EDGE_SHARE:
        return 0
    beside = slice(rows, rows + 6)
    level = [np.median(row[at]) if at.any() else 0.0 for row, at in zip(mean[beside], inside[beside], strict=True)]
    fading = 0
    while fading < min(MOST_FADING_PX, len(level) - 3) and level[fading] < FADING * level[fading + 2]:
        fading += 1
    return rows + fading
