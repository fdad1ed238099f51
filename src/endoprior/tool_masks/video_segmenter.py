"""Find the tools of a sequence with a video segmenter: our own finder prompts it, it carries the masks over the clip.

Two rounds: the first prompts the best frame of each stretch of the clip. The second prompts regions that our own finder
sees and that no carried mask covers: tools that were in view only between the frames of the first. Masks are carried
forward and backward, in chunks, so that memory does not grow with the clip.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Protocol

import cv2
import numpy as np

from ..data import FrameSequence
from ..data.found_tools import FoundTools
from ..footage.image_operations import AREA, Image, Mask, components, dilated, disk
from .mask_store import MaskStore, read_state, write_state
from .tool_finder import Progress, find_in_sequence, no_progress

ROUNDS = 2
AGREEMENT = 0.5
"""Intersection over union of the carried and the found mask of a frame, below which the frame counts as uncertain."""
CHUNK = 24  # Frames that a segmenter remembers: SAM 2 keeps 13 MB per frame, and 6 MB per frame and object
PATIENCE = 25
"""After so many frames without any of the objects the rest is left: what enters later has prompts of its own."""
STRETCH = 50
"""At most one frame is prompted in each stretch of so many frames: a tool that enters later is found there."""
RIM_SHARE = 1 / 320
"""Width of the rim that found tools have around them, as a share of the image width: 2 px of 640."""
MIN_PROMPT_REGION_SHARE = 0.002  # Smaller regions, as a share of the image, prompt nothing
MAX_REGIONS = 6  # Of one frame, the largest first. Each is an object of its own, which takes memory and time
COVERED = 0.1  # A region with at least this share inside masks that were carried before is not new


class Chunk(Protocol):
    """What a segmenter remembers of a few successive frames."""

    def show(self, rgb_u8: Image, masks: Sequence[Mask]) -> None:
        """Give a frame (H, W, 3) whose objects are known: (H, W) each, empty for one that is out of view."""
        ...

    def follow(self, rgb_u8: Image) -> list[Mask]:
        """The same objects in the next frame (H, W, 3): (H, W) each."""
        ...


class VideoSegmenter(Protocol):
    """A network that follows objects through a video."""

    name: str
    """For the user: `SAM 2 (facebook/...)`."""

    def begin(self) -> Chunk:
        """A new chunk that remembers nothing."""
        ...


@dataclass(frozen=True)
class Prompt:
    """A frame whose tool regions are carried, and how far."""

    frame: int
    first: int  # Carried backward to this frame
    last: int  # Carried forward to this frame


def segment_sequence(
    sequence: FrameSequence,
    segmenter: VideoSegmenter,
    work: Path,
    *,
    refine: bool = False,
    progress: Progress = no_progress,
) -> Iterator[tuple[Mask, FoundTools]]:
    """Find the tools of every frame as `find_in_sequence` does. The confidence is that of our own finder, lowered where
    the two disagree. `work` keeps masks on the way: an interrupted run on the same sequence resumes.
    """
    clip = _Clip(sequence, work)
    clip.find(refine, progress)
    for number in range(ROUNDS):
        clip.carry_round(number, segmenter, progress)
    for i in range(len(sequence)):
        yield clip.result(i, refine)


class _Clip:
    """A sequence, and its masks on the way; everything that takes long is in the folder `work`."""

    def __init__(self, sequence: FrameSequence, work: Path) -> None:
        size = sequence.camera(0).width, sequence.camera(0).height
        self.empty = np.zeros(size[::-1], bool)
        self.sequence, self.work, self.state = sequence, work, read_state(work)
        self.found, self.outside = MaskStore(work / "found", size), MaskStore(work / "outside", size)
        if len(self.state.get("confidence", ())) != len(sequence):
            self.state = {}
        self.rounds = [MaskStore(work / f"round{number}", size) for number in range(ROUNDS)]

    def find(self, refine: bool, progress: Progress) -> None:
        """Our own finder, on every frame."""
        if "confidence" in self.state:
            return
        confidence = []
        for i, (mask, found) in enumerate(find_in_sequence(self.sequence, refine=refine, progress=progress)):
            self.found.put(i, found.tool_mask)
            self.outside.add(0, mask & ~found.tool_mask)  # the border of the view, one for the clip
            confidence.append(float(found.confidence))
        self._note(confidence=confidence)

    def carry_round(self, number: int, segmenter: VideoSegmenter, progress: Progress) -> None:
        """Choose frames to prompt, and carry their regions in both directions."""
        if f"prompts{number}" not in self.state:
            scores = [
                self.state["confidence"][i] * sum(int(region.sum()) for region in self._regions(i, number))
                for i in range(len(self.sequence))
            ]
            chosen = [[each.frame, each.first, each.last] for each in choose_prompts(scores)]
            self._note(**{f"prompts{number}": chosen})
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
                    carried = carry(segmenter, lambda i: self.sequence.frame(i).rgb_u8, order, regions)
                    for count, (i, mask) in enumerate(carried, 1):
                        store.add(i, mask)
                        progress(step, done + count, total)
                    self._note(carried=[*self.state.get("carried", []), key])
                done += len(order) - 1

    def result(self, index: int, refine: bool) -> tuple[Mask, FoundTools]:
        """The masks of one frame, as `find_in_sequence` yields them."""
        outside, own = self.outside.mask(0), self.found.mask(index)
        mask = with_rim(self._carried(index, ROUNDS))
        if refine:
            mask |= ~self.sequence.frame(index).tissue_mask
        mask &= ~outside
        either = mask | own
        shared = float((mask & own).sum() / either.sum()) if either.any() else 1.0
        confidence = self.state["confidence"][index] * min(1.0, shared / AGREEMENT)
        return mask | outside, FoundTools(mask, confidence)

    def _carried(self, index: int, rounds: int) -> Mask:
        """(H, W) what the first `rounds` rounds carried to a frame."""
        return np.any([self.empty, *(store.mask(index) for store in self.rounds[:rounds])], axis=0)

    def _regions(self, index: int, number: int) -> list[Mask]:
        """Regions of a frame that earlier rounds do not cover."""
        return sure_regions(self.found.mask(index), self._carried(index, number) if number else None)

    def _note(self, **facts: object) -> None:
        self.state |= facts
        write_state(self.work, self.state)


def choose_prompts(scores: Sequence[float], stretch: int = STRETCH) -> list[Prompt]:
    """The frame of highest score in each stretch of the clip, and how far it is carried: to the next ones' frames. A
    score is confidence times area of the sure regions; 0 where there is nothing to carry.
    """
    best = []
    for start in range(0, len(scores), stretch):
        frame = max(range(start, min(start + stretch, len(scores))), key=lambda i: scores[i])
        if scores[frame] > 0:
            best.append(frame)
    ends = [0, *best, len(scores) - 1]
    return [Prompt(frame, ends[i], ends[i + 2]) for i, frame in enumerate(best)]


def rim_px(width: int) -> int:
    """Width of the rim around found tools, px, in an image of `width` px."""
    return max(1, round(width * RIM_SHARE))


def sure_regions(tool_mask: Mask, covered: Mask | None = None) -> list[Mask]:
    """The connected regions of a tool mask (H, W) without its rim, the largest first, at most `MAX_REGIONS`; without
    those that lie in `covered`, tools that are known already.
    """
    # The image's edge is not an edge of the tool: nothing is taken off there.
    labels, boxes = components(cv2.erode(tool_mask.astype(np.uint8), disk(rim_px(tool_mask.shape[1]))) > 0)
    areas = boxes[:, AREA]
    order = sorted(range(1, len(areas)), key=lambda i: (-areas[i], i))
    large = [labels == i for i in order if areas[i] >= MIN_PROMPT_REGION_SHARE * tool_mask.size]
    if covered is not None:
        large = [region for region in large if covered[region].mean() < COVERED]
    return large[:MAX_REGIONS]


def with_rim(tool_mask: Mask) -> Mask:
    """(H, W) a carried mask with the rim that `sure_regions` takes off: color of a tool bleeds over its edge."""
    return dilated(tool_mask, disk(rim_px(tool_mask.shape[1])))


def carry(
    segmenter: VideoSegmenter, frame: Callable[[int], Image], order: Sequence[int], regions: Sequence[Mask]
) -> Iterator[tuple[int, Mask]]:
    """Carry regions of the first frame of `order` over the others: yields each, and (H, W) True on any of the objects.

    Every chunk sees the first frame again, where the objects are surely right, and the last frame of the chunk before.
    It ends when all objects are out of view for `PATIENCE` frames. `frame` decodes a frame (H, W, 3); it is called in
    this order, and for few frames twice.
    """
    masks, empty = list(regions), 0
    for start in range(0, len(order) - 1, CHUNK):
        chunk = segmenter.begin()
        chunk.show(frame(order[0]), regions)
        if start:
            chunk.show(frame(order[start]), masks)
        for index in order[start + 1 : start + 1 + CHUNK]:
            masks = chunk.follow(frame(index))
            union = np.any(masks, axis=0)
            empty = 0 if union.any() else empty + 1
            yield index, union
            if empty == PATIENCE:
                return
