"""Find the tools in all frames of a sequence folder."""

from __future__ import annotations

from collections.abc import Callable, Iterator

import cv2
import numpy as np
from numpy.typing import NDArray

from ..core.ranges import spread
from ..core.types import Frame
from ..data import FrameSequence
from ..data.found_tools import FoundTools
from ..footage.border import find_outline, masked_border
from .finder import ToolFinder

SAMPLES = 16
"""Number of frames from which the border of the view is taken."""
Progress = Callable[[str, int, int], None]


def find_in_sequence(
    sequence: FrameSequence, *, refine: bool = False, progress: Progress = lambda what, done, total: None
) -> Iterator[tuple[NDArray[np.bool_], FoundTools]]:
    """Find the tools of every frame, in order.

    Args:
        refine: the masks of the sequence are right but incomplete: only add pixels, in regions that touch them.
        progress: called with the name of the step, the number of frames done, and their total.
    Yields:
        (H, W) True on everything that is not tissue, as a mask file stores it; and the tools of the frame.
    """
    total, finder = len(sequence), ToolFinder()
    view = view_of([sequence.frame(i) for i in spread(total, SAMPLES)])
    for i in range(total):
        frame = sequence.frame(i)
        found = finder.find(frame.rgb_u8, view)
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


def _added(given: NDArray[np.bool_], found: NDArray[np.bool_]) -> NDArray[np.bool_]:
    """`given`, and the regions of `found` that touch it."""
    count, label = cv2.connectedComponents((given | found).astype(np.uint8))
    touches = np.zeros(count, bool)
    touches[np.unique(label[given])] = True
    touches[0] = False
    return touches[label] | given
