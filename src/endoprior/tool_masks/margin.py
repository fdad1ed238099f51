"""Leave out what tools color around their masks: as many pixels as measured on the clip, none where masks are exact.

What is learned beside a tool that rests fills the gap behind it, so a rim of its color becomes a stripe there.
`H, W` image size.
"""

from __future__ import annotations

import cv2
import numpy as np
from numpy.typing import NDArray

from ..core.ranges import spread
from ..data import FrameSequence
from .color_reach import ColorReach, color_reach
from .regions import LEAST_SHARE, disk
from .sequence import view_of

SAMPLES = 16
"""Training frames that are measured."""


def measured_reach(sequence: FrameSequence) -> tuple[ColorReach, NDArray[np.bool_]]:
    """How far tools color the pixels around their masks in the training frames, and (H, W) True inside the view."""
    indices = sequence.indices("train")
    frames = [sequence.frame(indices[k]) for k in spread(len(indices), SAMPLES)]
    view = view_of(frames)
    return color_reach(((frame.rgb_u8, frame.tissue_mask) for frame in frames), view), view


def with_tool_margin(sequence: FrameSequence) -> tuple[FrameSequence, int]:
    """The sequence without the pixels that tools color, and the width of the margin around their masks, px."""
    reach, view = measured_reach(sequence)
    margin_px = reach.margin_px
    if not margin_px:
        return sequence, 0
    return sequence.with_tissue(lambda frame: away_from_tools(frame.tissue_mask, view, margin_px)), margin_px


def away_from_tools(tissue: NDArray[np.bool_], view: NDArray[np.bool_], margin_px: int) -> NDArray[np.bool_]:
    """(H, W) `tissue` without the pixels up to `margin_px` from a tool.

    Tools are the masked regions in the view of at least `LEAST_SHARE` of it. Others are failed stereo, highlights and
    the like, and beyond the view there is nothing whose color could reach into it.

    Args:
        tissue, view: (H, W) True on tissue, and inside the endoscope's image.
    """
    masked = (~tissue & view).astype(np.uint8)
    _, label, stats, _ = cv2.connectedComponentsWithStats(masked, connectivity=8)
    is_tool = stats[:, cv2.CC_STAT_AREA] >= LEAST_SHARE * view.sum()
    is_tool[0] = False
    return tissue & (cv2.dilate(is_tool[label].astype(np.uint8), disk(margin_px)) == 0)
