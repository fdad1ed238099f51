"""Find the tools of a sequence with a video segmenter: our own finder prompts it, it carries the masks over the clip.

Two rounds: the first prompts the best frame of each stretch of the clip. The second prompts regions that our own finder
sees and that no carried mask covers: tools that were in view only between the frames of the first.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from ..data import FrameSequence
from ..data.found_tools import FoundTools
from .carry import VideoSegmenter, carry
from .mask_store import MaskStore, read_state, write_state
from .prompts import Prompt, choose_prompts, sure_regions, with_rim
from .sequence import Progress, find_in_sequence

ROUNDS = 2
AGREEMENT = 0.5
"""Intersection over union of the carried and the found mask of a frame, below which the frame counts as uncertain."""


def segment_sequence(
    sequence: FrameSequence,
    segmenter: VideoSegmenter,
    work: Path,
    *,
    refine: bool = False,
    progress: Progress = lambda what, done, total: None,
) -> Iterator[tuple[NDArray[np.bool_], FoundTools]]:
    """Find the tools of every frame, in order.

    Args:
        segmenter: follows objects through the video.
        work: folder for masks on the way. If it holds those of an interrupted run on the same sequence, that resumes.
        refine: the masks of the sequence are right but incomplete: only add pixels to them.
        progress: called with the name of the step, the number of frames done, and their total.
    Yields:
        As `find_in_sequence`. The confidence is that of our own finder, lowered where the two disagree.
    """
    clip = _Clip(sequence, work)
    clip.find(refine, progress)
    for number in range(ROUNDS):
        clip.carry_round(number, segmenter, progress)
    for i in range(len(sequence)):
        yield clip.result(i, refine)


@dataclass
class _Clip:
    """A sequence, and its masks on the way; everything that takes long is in the folder `work`."""

    sequence: FrameSequence
    work: Path

    def __post_init__(self) -> None:
        camera = self.sequence.camera(0)
        size = camera.width, camera.height
        self.found = MaskStore(self.work / "found", size)
        self.outside = MaskStore(self.work / "outside", size)
        self.rounds = [MaskStore(self.work / f"round{number}", size) for number in range(ROUNDS)]
        self.state = read_state(self.work)

    def find(self, refine: bool, progress: Progress) -> None:
        """Our own finder, on every frame."""
        if "confidence" in self.state:
            return
        confidence = []
        for i, (mask, found) in enumerate(find_in_sequence(self.sequence, refine=refine, progress=progress)):
            self.found.put(i, found.mask)
            self.outside.add(0, mask & ~found.mask)  # the border of the view, one for the clip
            confidence.append(float(found.confidence))
        self._note(confidence=confidence)

    def carry_round(self, number: int, segmenter: VideoSegmenter, progress: Progress) -> None:
        """Choose frames to prompt, and carry their regions in both directions."""
        if f"prompts{number}" not in self.state:
            chosen = choose_prompts([self._score(i, number) for i in range(len(self.sequence))])
            self._note(**{f"prompts{number}": [[each.frame, each.first, each.last] for each in chosen]})
        prompts = [Prompt(*row) for row in self.state[f"prompts{number}"]]
        store, step = self.rounds[number], f"following tools, round {number + 1}"
        total, done = sum(each.last - each.first for each in prompts), 0
        for each in prompts:
            regions = self._regions(each.frame, number)
            store.add(each.frame, np.any(regions, axis=0))
            forward, backward = range(each.frame, each.last + 1), range(each.frame, each.first - 1, -1)
            for direction, order in (("forward", forward), ("backward", backward)):
                key = f"{number} {each.frame} {direction}"
                if key not in self.state.get("carried", []):
                    for count, (i, mask) in enumerate(carry(segmenter, self._image, order, regions), 1):
                        store.add(i, mask)
                        progress(step, done + count, total)
                    self._note(carried=[*self.state.get("carried", []), key])
                done += len(order) - 1

    def result(self, index: int, refine: bool) -> tuple[NDArray[np.bool_], FoundTools]:
        """The masks of one frame, as `find_in_sequence` yields them."""
        outside, own = self.outside.mask(0), self.found.mask(index)
        mask = with_rim(self._carried(index, ROUNDS))
        if refine:
            mask |= ~self.sequence.frame(index).tissue_mask
        mask &= ~outside
        shared = _share(mask & own, mask | own)
        confidence = self.state["confidence"][index] * min(1.0, shared / AGREEMENT)
        return mask | outside, FoundTools(mask, confidence)

    def _carried(self, index: int, rounds: int) -> NDArray[np.bool_]:
        """(H, W) what the first `rounds` rounds carried to a frame."""
        empty = np.zeros((self.sequence.camera(0).height, self.sequence.camera(0).width), bool)
        return np.any([empty, *(store.mask(index) for store in self.rounds[:rounds])], axis=0)

    def _regions(self, index: int, number: int) -> list[NDArray[np.bool_]]:
        """Regions of a frame that earlier rounds do not cover."""
        return sure_regions(self.found.mask(index), self._carried(index, number) if number else None)

    def _score(self, index: int, number: int) -> float:
        area = sum(int(region.sum()) for region in self._regions(index, number))
        return self.state["confidence"][index] * area

    def _image(self, index: int) -> NDArray[np.uint8]:
        return self.sequence.frame(index).rgb_u8

    def _note(self, **facts: object) -> None:
        self.state |= facts
        write_state(self.work, self.state)


def _share(part: NDArray[np.bool_], whole: NDArray[np.bool_]) -> float:
    """Area of the first over that of the second; 1 if the second is empty."""
    return float(part.sum() / whole.sum()) if whole.any() else 1.0
