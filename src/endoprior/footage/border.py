"""Where the endoscope image ends: straight and round borders of one clip together.

Shared letters: `K` sample images of one clip, (H, W, 3) uint8 each.
"""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from .black_arcs import black_arcs
from .circle import Circle
from .round_border import find_circle
from .strips import BLACK_LEVEL, Strips, find_strips

__all__ = ["Circle", "Outline", "Strips", "find_circle", "find_outline", "find_strips", "masked_border"]


@dataclass(frozen=True)
class Outline:
    """Where the endoscope image ends, judging by the images alone."""

    strips: Strips
    circle: Circle | None
    in_strip: NDArray[np.bool_]
    """(H, W) True in the strips."""
    outside: NDArray[np.bool_]
    """(H, W) True outside of the circle, on its rim, and on black parts inside of it."""


def find_outline(images: Sequence[NDArray[np.uint8]]) -> Outline:
    """Detect strips and a round border in (H, W, 3) sample images."""
    height, width = images[0].shape[:2]
    circle = find_circle(images)
    strips = find_strips(images, circle)
    in_strip = np.ones((height, width), bool)
    in_strip[strips.top : height - strips.bottom, strips.left : width - strips.right] = False
    outside = np.zeros((height, width), bool)
    if circle:
        outside = ~circle.mask(width, height, circle.margin_px) | black_arcs(images, circle)
    return Outline(strips, circle, in_strip, outside)


def masked_border(
    outline: Outline, images: Sequence[NDArray[np.uint8]], tissue_masks: Iterable[NDArray[np.bool_]]
) -> NDArray[np.bool_]:
    """(H, W) True where no frame is tissue and no image shows anything: black, or beyond the outline.

    Args:
        images: sample images, (H, W, 3).
        tissue_masks: (H, W) each, of every frame.
    """
    masked = outline.in_strip | outline.outside | (np.maximum.reduce(images).max(-1) < BLACK_LEVEL)
    for tissue in tissue_masks:
        masked &= ~tissue
    return masked
