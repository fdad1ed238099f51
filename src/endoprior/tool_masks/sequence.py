"""Find the tools in all frames of a sequence folder."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from dataclasses import replace

import numpy as np

from ..core.ranges import evenly_spaced
from ..core.types import Frame
from ..data import FrameSequence
from ..data.found_tools import FoundTools
from ..footage.border import find_outline, masked_border
from ..footage.components import Mask, components, regions_where
from .network import ToolFinder, full_size

SAMPLES = 16  # Number of frames from which the border of the view is taken
Progress = Callable[[str, int, int], None]


def no_progress(_what: str, _done: int, _total: int) -> None:
    """Report nothing."""


def find_in_sequence(
    sequence: FrameSequence, *, refine: bool = False, progress: Progress = no_progress
) -> Iterator[tuple[Mask, FoundTools]]:
    """Find the tools of every frame, in order: (H, W) True on everything that is not tissue, as a mask file stores it,
    and the tools of the frame. `refine` only adds pixels to the sequence's masks, in regions that touch them.
    """
    total, finder = len(sequence), ToolFinder()
    view = view_of([sequence.frame(i) for i in evenly_spaced(total, SAMPLES)])
    images = (sequence.frame(i).rgb_u8 for i in range(total))
    for i, small in enumerate(finder.find_over_time(images, view)):
        frame, found = sequence.frame(i), replace(small, tool_mask=full_size(small.tool_mask, view.shape) & view)
        if refine:
            given = ~frame.tissue_mask & view
            labels, boxes = components(given | found.tool_mask)
            touches = np.isin(np.arange(len(boxes)), labels[given])
            found = FoundTools(regions_where(touches, labels), found.confidence)
        progress("finding tools", i + 1, total)
        yield found.tool_mask | ~view, found


def view_of(frames: Sequence[Frame]) -> Mask:
    """(H, W) True inside the endoscope's image: not beyond its border, and not masked and black in all frames."""
    images = [frame.rgb_u8 for frame in frames]
    outline = find_outline(images)
    masked = masked_border(outline, images, (frame.tissue_mask for frame in frames))
    return ~(outline.in_strip | outline.outside | masked)
