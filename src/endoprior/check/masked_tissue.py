"""What is masked as a tool and yet moves with the tissue in every frame: a ligament, fat, a scar.

A tool moves against the tissue, or rests while that moves. A region whose flow is that of the tissue around it, in
nearly all frames in which the tissue moves, is doubted. Where the tissue hardly moves, nothing can be told.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import cv2
import numpy as np
from numpy.typing import NDArray

from ..core.ranges import evenly_spaced
from ..footage.image_operations import AREA, Image, InOrder, Mask, components, disk, distance_inside
from ..footage.optical_flow import MIN_SIZE_PX, MOTION_S, difference_from_background, flow_pair, gray_for_flow

SIDE_PX = 160  # shorter side of the images that are compared
COMPARED, MIN_PAIRS = 24, 8  # pairs of frames; with fewer in which the tissue moves, nothing is said
MOVES_PX = 1.0  # the tissue moves if its median flow is above this, px
WITH_TISSUE = 0.3  # difference to the motion of the tissue, as a share of that: 0.04 on tissue, 1 on tools (medians)
NEARLY_ALL = 0.9  # share of the pairs
MIN_MASKED_REGION_SHARE = 0.003  # smaller regions, as a share of the image, are not judged
INNER_PX = 2  # rims of regions mix both motions


@dataclass(frozen=True)
class MaskedTissue:
    """A place that is masked, in the middle of a region that moves with the tissue."""

    frame: int
    x: int  # px of the image
    y: int


def find_masked_tissue(
    count: int, frames_per_second: float, color: Callable[[int], Image], tool: Callable[[int], Mask], each: InOrder
) -> MaskedTissue | None:
    """What moves with the tissue in nearly all of a few frames, spread over a sequence of `count`; None if nothing.

    Args:
        color, tool: give the image (H, W, 3) of a frame, and (H, W) True on its tools inside of the border.
        each: as `map`; threads can give the results, in order.
    """
    ahead = max(1, round(MOTION_S * frames_per_second))
    first = evenly_spaced(count - ahead, COMPARED) if count > ahead else []
    found = list(each(lambda i: _likest(color(i), color(i + ahead), tool(i), tool(i + ahead)), first))
    moving = [(i, ratio, place) for i, (speed, ratio, place) in zip(first, found, strict=True) if speed > MOVES_PX]
    alike = [(i, place) for i, ratio, place in moving if ratio < WITH_TISSUE]
    if len(moving) < MIN_PAIRS or len(alike) < NEARLY_ALL * len(moving):
        return None
    frame, (x, y) = alike[len(alike) // 2]
    return MaskedTissue(frame, x, y)


def _likest(first: Image, later: Image, tool: Mask, tool_later: Mask) -> tuple[float, float, tuple[int, int]]:
    """Median speed of the tissue, px; the least difference of a masked region to it, as a share of it, inf without
    one; and the middle (x, y) of that region, px of the image.
    """
    shrink = max(1, min(tool.shape) // SIDE_PX)
    before, after = gray_for_flow(first, shrink), gray_for_flow(later, shrink)
    nothing = 0.0, np.inf, (0, 0)
    if min(before.shape) < MIN_SIZE_PX:
        return nothing

    def small(mask: Mask) -> Mask:
        return cv2.resize(mask.astype(np.uint8), before.shape[::-1], interpolation=cv2.INTER_NEAREST) > 0

    tissue = ~small(tool | tool_later)
    if not tissue.any():
        return nothing
    flow = flow_pair(before, after)[0]
    difference, _ = difference_from_background(flow, tissue)
    speed = float(np.median(np.linalg.norm(flow[tissue], axis=-1)))
    inner = cv2.erode(small(tool & tool_later).astype(np.uint8), disk(INNER_PX)) > 0
    labels, boxes = components(inner)
    best = nothing[1:]
    for i in range(1, len(boxes)):
        if boxes[i, AREA] >= MIN_MASKED_REGION_SHARE * tissue.size:
            region = labels == i
            ratio = float(np.median(difference[region])) / max(speed, 1e-6)
            best = min(best, (ratio, _middle(region, shrink)))
    return speed, *best


def _middle(region: NDArray[np.bool_], shrink: int) -> tuple[int, int]:
    """(x, y) the place that is deepest inside of a region (h, w), px of the image."""
    y, x = np.unravel_index(np.argmax(distance_inside(np.pad(region, 1))[1:-1, 1:-1]), region.shape)
    return int((x + 0.5) * shrink), int((y + 0.5) * shrink)
