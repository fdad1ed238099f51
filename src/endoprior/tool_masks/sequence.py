"""Find the tools in all frames of a sequence folder."""

from __future__ import annotations

from collections.abc import Callable, Iterator

import cv2
import numpy as np
from numpy.typing import NDArray

from ..core.spread import spread
from ..core.types import Frame
from ..data import FrameSequence
from ..footage.border import find_outline, masked_border
from ..footage.optical_flow import MOTION_S
from .model import FoundTools, ToolSample, fit_tools

SAMPLES = 16
"""Number of frames that the model is fitted to."""
Progress = Callable[[str, int, int], None]


def find_in_sequence(
    sequence: FrameSequence, *, refine: bool = False, progress: Progress = lambda what, done, total: None
) -> Iterator[tuple[NDArray[np.bool_], FoundTools]]:
    """Find the tools of every frame, in order.

    Args:
        refine: the masks of the sequence are right but incomplete: learn tools from them too, and only add pixels.
        progress: called with the name of the step, the number of frames done, and their total.
    Yields:
        (H, W) True on everything that is not tissue, as a mask file stores it; and the tools of the frame.
    """
    total = len(sequence)
    chosen = spread(total, SAMPLES)
    ahead = max(1, round(MOTION_S * (sequence.frames_per_second or 10.0)))
    frames = [sequence.frame(i) for i in chosen]
    view = view_of(frames)
    samples = []
    for i, frame in zip(chosen, frames, strict=True):
        later = sequence.frame(i + ahead).rgb_u8 if i + ahead < total else None
        given = ~frame.tissue_mask & view if refine else None
        samples.append(ToolSample(frame.rgb_u8, view, later, _depth(sequence, frame), given))
    progress("learning tools", 0, total)
    model = fit_tools(samples)
    for i in range(total):
        frame = sequence.frame(i)
        found = model.find(frame.rgb_u8, view, _depth(sequence, frame))
        if refine:
            found = FoundTools(_added(~frame.tissue_mask & view, found.mask), found.confidence)
        progress("finding tools", i + 1, total)
        yield found.mask | ~view, found


def view_of(frames: list[Frame]) -> NDArray[np.bool_]:
    """(H, W) True inside the endoscope's image: not beyond its border, and not masked and black in all frames."""
    images = [frame.rgb_u8 for frame in frames]
    outline = find_outline(images)
    masked = masked_border(outline, images, (frame.tissue_mask for frame in frames))
    return ~(outline.in_strip | outline.outside | masked)


def _depth(sequence: FrameSequence, frame: Frame) -> NDArray[np.float32] | None:
    """Measured depth; relative depth comes from images, which say nothing about a mirror."""
    return None if sequence.depth_is_relative or not frame.depth_valid.any() else frame.depth


def _added(given: NDArray[np.bool_], found: NDArray[np.bool_]) -> NDArray[np.bool_]:
    """`given`, and the regions of `found` that touch it."""
    count, label = cv2.connectedComponents((given | found).astype(np.uint8))
    touches = np.zeros(count, bool)
    touches[np.unique(label[given])] = True
    touches[0] = False
    return touches[label] | given
