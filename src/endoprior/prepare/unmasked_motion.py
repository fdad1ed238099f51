"""Tools that the masks likely miss: what enters the view and moves against its surroundings, and no mask covers.

Two frames a tenth of a second apart are compared. The motion of the background, by a camera or by breathing, is smooth:
a quadratic function of the position explains it, fitted so that what moves otherwise hardly counts. A tool that moves
differs from it by far, and enters from the border end first; so does little else. A tool that rests, or that moves with
the camera, is not seen this way.

`H, W` size of the frames, `h, w` of the resized images, about 160 px on their shorter side.
"""

from __future__ import annotations

from collections.abc import Callable

import cv2
import numpy as np
from numpy.typing import NDArray

from ..core.ranges import evenly_spaced
from ..footage.image_operations import InOrder
from ..footage.optical_flow import MIN_SIZE_PX, MOTION_S, difference_from_background, flow_pair, gray_for_flow
from ..tool_masks.regions import disk, entering_regions

COMPARED = 24  # number of frames that are compared with a later one
SIDE_PX = 160
# Largest forward-backward error of the flow, px, plus this share of the step ...
MOTION_ROUND_TRIP_PX, MOTION_ROUND_TRIP_SHARE = 0.7, 0.1
MIN_AGREEING = 0.8  # ... on this share of the tissue. Where haze or darkness leaves less, nothing can be said.
# Least difference from the background motion, px, and as a multiple of that of the median pixel. At 1.5 and 5, frames
# without tools are named in fetoscopy and colonoscopy.
MIN_MOTION_PX, TIMES_MEDIAN = 2.0, 8.0
NEAR_TOOL_PX = 8  # motion this near to a mask is that of its tool, or of tissue that it pulls
MIN_MOVING_REGION_SHARE = 0.01  # smaller regions, as a share of the view, are not reported
SMOOTH_PX = 2.0
Image, Mask = NDArray[np.uint8], NDArray[np.bool_]


def frames_with_unmasked_motion(
    count: int, frames_per_second: float, color: Callable[[int], Image], tool: Callable[[int], Mask], view: Mask,
    each: InOrder = map,
) -> list[int]:  # fmt: skip
    """Of a few frames, spread over a sequence of `count`, those of `moves_unmasked`.

    Args:
        color, tool: give the image (H, W, 3) of a frame, and (H, W) True on its tools.
        view: (H, W) True inside the endoscope's image.
        each: as `map`; threads can give the results, in order.
    """
    ahead = max(1, round(MOTION_S * frames_per_second))
    compared = evenly_spaced(count - ahead, COMPARED) if count > ahead else []

    def moves(i: int) -> bool:
        # What a tool covers or uncovers has no flow: it counts as masked where the tool is in either frame.
        return moves_unmasked(color(i), color(i + ahead), view, (tool(i) | tool(i + ahead)) & view)

    return [i for i, found in zip(compared, each(moves, compared), strict=True) if found]


def moves_unmasked(first: Image, later: Image, view: Mask, tool: Mask) -> bool:
    """Whether something enters the view of the first frame, moves against its surroundings, and is not masked.

    Args:
        first, later: (H, W, 3) about 0.1 s apart.
        view: (H, W) True inside the endoscope's image.
        tool: (H, W) True on the masked tools of either frame.
    """
    shrink = max(1, min(view.shape) // SIDE_PX)
    before, after = gray_for_flow(first, shrink), gray_for_flow(later, shrink)
    if min(before.shape) < MIN_SIZE_PX:
        return False
    size, how = before.shape[::-1], cv2.INTER_NEAREST
    view, tool = (cv2.resize(mask.astype(np.uint8), size, interpolation=how) > 0 for mask in (view, tool))
    forward, backward = flow_pair(before, after)
    background = (cv2.erode(view.astype(np.uint8), disk(3)) > 0) & ~tool
    if not background.any() or _agree(forward, backward)[background].mean() < MIN_AGREEING:
        return False
    difference, usual = difference_from_background(forward, background)
    most = max(TIMES_MEDIAN * usual, MIN_MOTION_PX)
    near = cv2.dilate(tool.astype(np.uint8), disk(NEAR_TOOL_PX)) > 0
    moving = (cv2.GaussianBlur(difference, (0, 0), SMOOTH_PX) > most) & view & ~near
    moving = np.asarray(cv2.morphologyEx(moving.astype(np.uint8), cv2.MORPH_OPEN, disk(3)), np.uint8)
    return bool(entering_regions(moving, view).sum() > MIN_MOVING_REGION_SHARE * view.sum())


def _agree(forward: NDArray[np.float32], backward: NDArray[np.float32]) -> Mask:
    """(h, w) True where the way back leads to the start."""
    y, x = np.mgrid[: forward.shape[0], : forward.shape[1]].astype(np.float32)
    there = x + forward[..., 0], y + forward[..., 1]
    back = cv2.remap(backward, *there, cv2.INTER_LINEAR, borderMode=cv2.BORDER_REPLICATE)
    error, step = (np.linalg.norm(flow, axis=-1) for flow in (forward + back, forward))
    return error < MOTION_ROUND_TRIP_PX + MOTION_ROUND_TRIP_SHARE * step
