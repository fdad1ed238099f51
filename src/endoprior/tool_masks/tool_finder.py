"""Finds the tools of single frames, of clips and of sequence folders with the tool network.

The masks are a starting point: correct them in the viewer, or pass your own. `H, W` is the size of a frame, `h, w` that
of the image that the network gets.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Iterator
from dataclasses import replace

import cv2
import numpy as np
import torch
from numpy.typing import NDArray

from ..core.ranges import evenly_spaced
from ..data import FrameSequence, Split
from ..data.found_tools import FoundTools
from ..footage.border import find_outline, masked_border
from ..footage.image_operations import Image, InOrder, Mask, components, regions_where
from .network import MULTIPLE, ToolNetwork, full_size, network_image, shipped_network, small_view
from .over_time import FramePrediction, decide_over_time
from .regions import tool_regions

MAYBE = 0.25  # Pixels of a higher probability may be a tool: they count in the confidence
MIN_DOUBT = 0.004  # Share of the view in doubt from which on a frame without a mask is uncertain
SAMPLES = 16  # Number of frames from which the border of the view is taken
Progress = Callable[[str, int, int], None]


class ToolFinder:
    """Finds the tools of single frames, and of clips."""

    def __init__(self, network: ToolNetwork | None = None) -> None:
        """Take a network in place of the one that comes with the program."""
        self._network = network or shipped_network()

    def log_odds(self, rgb_u8: Image, view: Mask, turned: bool = True) -> NDArray[np.float32]:
        """(h, w) log-odds of a tool of a frame (H, W, 3) in the view (H, W).

        Args:
            turned: mean over the frame and itself turned by 180 degrees, which is steadier and takes twice as long.
        """
        image = torch.from_numpy(network_image(rgb_u8, view))
        h, w = image.shape[1:]
        flips = ((), (-1, -2)) if turned else ((),)
        images = torch.stack([image.flip(flip) for flip in flips])
        images = torch.nn.functional.pad(images, (0, -w % MULTIPLE, 0, -h % MULTIPLE))
        with torch.inference_mode():
            found = self._network(images.contiguous(memory_format=torch.channels_last))[:, :h, :w]
        return torch.stack([one.flip(flip) for one, flip in zip(found, flips, strict=True)]).mean(0).numpy()

    def find(self, rgb_u8: Image, view: Mask) -> FoundTools:
        """Find the tools of one frame; arguments as in `log_odds`."""
        if not view.any():
            return FoundTools(np.zeros_like(view), 1.0)
        log_odds, small = self.log_odds(rgb_u8, view), small_view(view)
        mask = tool_regions(log_odds, small)
        return FoundTools(full_size(mask, view.shape) & view, _confidence(mask, log_odds, small))

    def find_over_time(self, images: Iterable[Image], view: Mask, each: InOrder = map) -> Iterator[FoundTools]:
        """Find the tools of all frames of a clip, (h, w) at the network's size: see `full_size`.

        Args:
            images: (H, W, 3), in order. view: (H, W).
            each: as `map`; threads can give the results, in order.
        """
        small = small_view(view)

        def predict(rgb_u8: Image) -> FramePrediction:
            shrunk = cv2.resize(rgb_u8, small.shape[::-1], interpolation=cv2.INTER_AREA)
            return FramePrediction(np.asarray(shrunk, np.uint8), self.log_odds(rgb_u8, view))

        for tools in decide_over_time(each(predict, images), small):
            yield FoundTools(tools.tool_mask, _confidence(tools.tool_mask, tools.log_odds, small))


def _confidence(mask: Mask, log_odds: NDArray[np.float32], view: Mask) -> float:
    """That of `FoundTools`, from (h, w) arrays."""
    probability = 1 / (1 + np.exp(-log_odds))
    maybe = probability[(mask | (probability > MAYBE)) & view]
    enough = mask.any() or maybe.size > MIN_DOUBT * view.sum()
    return float(np.abs(2 * maybe - 1).mean()) if enough else 1.0


def no_progress(_what: str, _done: int, _total: int) -> None:
    """Report nothing."""


def find_in_sequence(
    sequence: FrameSequence, *, refine: bool = False, progress: Progress = no_progress
) -> Iterator[tuple[Mask, FoundTools]]:
    """Find the tools of every frame, in order: (H, W) True on everything that is not tissue, as a mask file stores it,
    and the tools of the frame. `refine` only adds pixels to the sequence's masks, in regions that touch them.
    """
    total, finder = len(sequence), ToolFinder()
    view = view_of(sequence)
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


def view_of(sequence: FrameSequence, split: Split = "video", samples: int = SAMPLES) -> Mask:
    """(H, W) True inside the endoscope's image: not beyond its border, and not masked and black in all of some frames
    of the split, evenly spaced.
    """
    every = sequence.frames(split)
    frames = [every[k] for k in evenly_spaced(len(every), samples)]
    images = [frame.rgb_u8 for frame in frames]
    outline = find_outline(images)
    masked = masked_border(outline, images, (frame.tissue_mask for frame in frames))
    return ~(outline.in_strip | outline.outside | masked)
