"""One click on tissue that the masks take for a tool frees it in all frames.

The masked region under the click is carried along the optical flow, from frame to frame and both ways in time. In each
frame, a masked region that lies mostly under it is the same thing and is freed whole; where it merges with a tool, only
the carried part is. `H, W` image size.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from itertools import pairwise

import cv2
import numpy as np

from ..core.checks import input_error
from ..core.ranges import evenly_spaced
from ..data import FrameSequence
from ..footage.carry_masks import sampled
from ..footage.components import AREA, Mask, components, regions_where
from ..footage.optical_flow import MIN_SIZE_PX, flow_pair, gray_for_flow
from .clicked_tools import SearchStep, ToolClick, demand_in_image
from .sequence import SAMPLES, view_of

SHARED = 0.5  # Least share of a masked region that lies under the carried one
LEFT = 0.2  # With less of its first area the carried region has left the image


def free_clicked(
    sequence: FrameSequence, clicks: Sequence[ToolClick], tool: Callable[[int], Mask]
) -> Iterator[SearchStep]:
    """Find what to free in every frame, one frame a step, each once for every click.

    Args:
        tool: gives the mask (H, W) of a frame, True on everything that is not tissue.
    Raises:
        InputError: before the first step, for a click in no frame, outside of the image, or not on a mask.
    """
    for click in clicks:
        demand_in_image(click, sequence, tool)
        if not tool(click.frame)[int(click.y), int(click.x)]:
            subject, fix = f"click {click.frame},{click.x:g},{click.y:g}", "Choose a place that is masked."
            raise input_error(subject, "tissue that is masked", "a pixel that is not", fix)
    return _steps(sequence, clicks, tool)


def _steps(sequence: FrameSequence, clicks: Sequence[ToolClick], tool: Callable[[int], Mask]) -> Iterator[SearchStep]:
    count, done = len(sequence), 0
    view = view_of([sequence.frame(i) for i in evenly_spaced(count, SAMPLES)])
    for click in clicks:
        labels, _ = components(tool(click.frame) & view)
        clicked = (labels == labels[int(click.y), int(click.x)]) & (labels > 0)
        done += 1
        yield SearchStep(done, count * len(clicks), click.frame, clicked)
        for order in (range(click.frame, -1, -1), range(click.frame, count)):
            region = clicked
            for before, now in pairwise(order):
                region, freed = _next(sequence, before, now, region, tool(now) & view)
                if region.sum() < LEFT * clicked.sum():
                    region = np.zeros_like(region)
                done += 1
                yield SearchStep(done, count * len(clicks), now, freed)


def _next(sequence: FrameSequence, before: int, now: int, region: Mask, masked: Mask) -> tuple[Mask, Mask]:
    """The region of one frame in the next, and (H, W) what to free there."""
    if not region.any():
        return region, region
    moved = _moved(region, sequence.frame(before).rgb_u8, sequence.frame(now).rgb_u8)
    labels, boxes = components(masked)
    shared = np.bincount(labels[moved], minlength=len(boxes)) / boxes[:, AREA].clip(1)
    same = regions_where(shared > SHARED, labels)
    return (same, same) if same.any() else (moved, moved & masked)


def _moved(region: Mask, before: np.ndarray, now: np.ndarray) -> Mask:
    """(H, W) where the second image (H, W, 3) shows a region of the first."""
    grays = gray_for_flow(before), gray_for_flow(now)
    shape = grays[0].shape
    if min(shape) < MIN_SIZE_PX:
        return region
    back = flow_pair(*grays)[1]
    grid = np.dstack(np.meshgrid(*(np.arange(side, dtype=np.float32) for side in shape[::-1])))
    small = cv2.resize(region.astype(np.float32), shape[::-1], interpolation=cv2.INTER_AREA)
    there = sampled(np.asarray(small, np.float32), grid + back)
    return cv2.resize(there, region.shape[::-1], interpolation=cv2.INTER_LINEAR) > SHARED
