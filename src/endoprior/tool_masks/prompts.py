"""Choose what a video segmenter is told: tool regions that are surely right, in a few frames spread over the clip.

`T` frames. The program's own finder gives a mask and a confidence for each frame; a segmenter carries the best of them
to all other frames.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import cv2
import numpy as np
from numpy.typing import NDArray

STRETCH = 50
"""At most one frame is prompted in each stretch of so many frames: a tool that enters later is found there."""
RIM_SHARE = 1 / 320
"""Width of the rim that found tools have around them, as a share of the image width: 2 px of 640."""
LEAST_SHARE = 0.002
"""Smaller regions, as a share of the image, prompt nothing."""
MOST_REGIONS = 6
"""Of one frame, the largest first. Each is an object of its own, which takes memory and time."""
COVERED = 0.1
"""A region with at least this share inside masks that were carried before is not new."""


@dataclass(frozen=True)
class Prompt:
    """A frame whose tool regions are carried, and how far."""

    frame: int
    first: int
    """Carried backward to this frame."""
    last: int
    """Carried forward to this frame."""


def rim_px(width: int) -> int:
    """Width of the rim around found tools, px, in an image of `width` px."""
    return max(1, round(width * RIM_SHARE))


def sure_regions(
    mask: NDArray[np.bool_], covered: NDArray[np.bool_] | None = None, radius: int | None = None
) -> list[NDArray[np.bool_]]:
    """The connected regions of a tool mask without its rim, the largest first.

    Args:
        mask: (H, W) True on tools.
        covered: (H, W) True on tools that are known already: regions that lie in them are left out.
        radius: width of the rim, px; None is the usual one.
    Returns:
        At most `MOST_REGIONS` masks (H, W).
    """
    width = mask.shape[1]
    # The image's edge is not an edge of the tool: nothing is taken off there.
    core = cv2.erode(mask.astype(np.uint8), _disk(rim_px(width) if radius is None else radius))
    count, label, stats, _ = cv2.connectedComponentsWithStats(core, connectivity=8)
    areas = stats[:, cv2.CC_STAT_AREA]
    order = sorted(range(1, count), key=lambda i: (-int(areas[i]), i))
    large = [label == i for i in order if areas[i] >= LEAST_SHARE * mask.size]
    if covered is not None:
        large = [region for region in large if covered[region].mean() < COVERED]
    return large[:MOST_REGIONS]


def with_rim(mask: NDArray[np.bool_]) -> NDArray[np.bool_]:
    """(H, W) a carried mask with the rim that `sure_regions` takes off: color of a tool bleeds over its edge."""
    return cv2.dilate(mask.astype(np.uint8), _disk(rim_px(mask.shape[1]))) > 0


def choose_prompts(scores: Sequence[float], stretch: int = STRETCH) -> list[Prompt]:
    """The frame of highest score in each stretch of the clip, and how far it is carried: to the next ones' frames.

    Args:
        scores: of T frames, confidence times area of the sure regions; 0 where there is nothing to carry.
    Returns:
        Ascending frames; no frame of score 0.
    """
    best = []
    for start in range(0, len(scores), stretch):
        part = scores[start : start + stretch]
        frame = start + max(range(len(part)), key=lambda i: part[i])
        if scores[frame] > 0:
            best.append(frame)
    ends = [0, *best, len(scores) - 1]
    return [Prompt(frame, ends[i], ends[i + 2]) for i, frame in enumerate(best)]


def _disk(radius: int) -> NDArray[np.uint8]:
    """Structuring element of that radius, px."""
    return cv2.getStructuringElement(cv2.MORPH_ELLIPSE, (2 * radius + 1, 2 * radius + 1))
