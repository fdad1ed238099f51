"""Detect straight borders of the endoscope image: black bars and console strips.

Shared letters: `K` sample images of one clip, (H, W, 3) uint8 each. Strips stay black or static in all samples.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import cv2
import numpy as np
from numpy.typing import NDArray

from .circle import Circle
from .dark_outline import brightness

BLACK_LEVEL = 28
"""Levels 0..255 below this are black, including limited-range video with coding noise."""
MIN_STRIP_PX = 3
"""Thinner strips are ignored; they can be coding noise."""
MAX_STRIP_FRACTION = 0.25
"""Largest share of the image for one strip."""
STATIC_RATIO = 0.3
"""The change over time of a strip is below this share of the change in the image center ..."""
STRIP_CHROMA = 40
"""... and a strip is gray: the channels of half of its pixels differ by less than this."""
EDGE_SHARE = 0.55
"""Share of the strip's edge with a brightness step: strips have straight edges, shadows do not."""
EDGE_STEP = 12
"""Smallest brightness step, levels."""
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


def find_strips(images: Sequence[NDArray[np.uint8]], circle: Circle | None = None) -> Strips:
    """Detect black bars and static gray console strips at the sides.

    Args:
        images: K of one size, at different times; from a single image only black bars are detected.
        circle: round border; what lies outside of it is no strip and hides none.
    """
    grays = [cv2.cvtColor(image, cv2.COLOR_RGB2GRAY).astype(np.float32) for image in images]
    mean = sum(grays) / len(grays)
    change = np.sqrt(sum((gray - mean) ** 2 for gray in grays) / len(grays))
    high = [brightness(image) for image in images]
    low = np.maximum.reduce(high)
    channels = (cv2.split(image) for image in images)
    least = (cv2.min(cv2.min(red, green), blue) for red, green, blue in channels)
    chroma = sum((h - m).astype(np.float32) for h, m in zip(high, least, strict=True)) / len(images)
    middle = tuple(slice(n // 4, n - n // 4) for n in low.shape)
    central_change = float(np.median(change[middle]))
    height, width = low.shape
    inside = np.ones((height, width), bool)
    if circle:
        inside = circle.mask(width, height, circle.margin_px)
    found = []
    for turns in (0, 2, 1, 3):  # turned so that the side in question is on top: top, bottom, right, left
        maps = (np.rot90(m, turns) for m in (low, chroma, change, mean, inside))
        found.append(_strip_on_top(*maps, central_change))
    return Strips(top=found[0], bottom=found[1], left=found[3], right=found[2])


def _strip_on_top(
    low: NDArray[np.uint8],
    chroma: NDArray,
    change: NDArray,
    mean: NDArray,
    inside: NDArray[np.bool_],
    central_change: float,
) -> int:
    """Number of rows of a strip at the top of these (H, W) maps, 0 for none."""
    limit = int(MAX_STRIP_FRACTION * len(low))
    first = int(inside.any(1).argmax())  # rows above show nothing of the circle
    rows = first
    while rows <= limit:
        at = inside[rows]
        black = np.quantile(low[rows][at], 0.98) < BLACK_LEVEL
        static = np.quantile(change[rows][at], 0.8) < STATIC_RATIO * central_change  # False for one image
        if not (black or (static and np.median(chroma[rows][at]) < STRIP_CHROMA)):
            break
        rows += 1
    if rows < MIN_STRIP_PX or rows == first or rows > limit:
        return 0
    # A row of coding noise can lie between strip and image.
    jumps = [
        np.abs(mean[rows + d] - mean[rows - 1])[inside[rows - 1] & inside[rows + d]] > EDGE_STEP
        for d in (0, 1)
        if rows + d < len(mean)
    ]
    if max((jump.mean() for jump in jumps if jump.size), default=0.0) <= EDGE_SHARE:
        return 0
    level = [
        float(np.median(row[at])) if at.any() else 0.0
        for row, at in zip(mean[rows : rows + 6], inside[rows : rows + 6], strict=True)
    ]
    fading = 0
    while fading < min(MOST_FADING_PX, len(level) - 3) and level[fading] < FADING * level[fading + 2]:
        fading += 1
    return rows + fading
