"""Burnt-in text of a clip: where it is in each frame, painted black there, and masked.

Samples are searched first. Static text is taken to be in all frames from the sample before the first one that shows
it to the sample after the last one; only for text that moves are the frames searched. Text that moves and is in fewer
than three samples is missed.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass, field, replace

import numpy as np

from ..footage.image_operations import Image, Mask
from ..footage.text_network import TextBox, TextDetector
from ..footage.texts import confirm, follow, rectangle, text_mask
from ..system.console import ToDo
from .video_clip import StereoFrame

MAX_NAMED = 5  # texts that notes name; more are counted


@dataclass(frozen=True)
class BurntInText:
    """Text in the source images of one camera, (h, w)."""

    boxes: dict[int, list[TextBox]] = field(default_factory=dict)  # by the position of a frame in the source
    notes: Sequence[str] = field(default_factory=list)  # for the user, one line, where there is text

    def mask(self, index: int, shape: tuple[int, ...]) -> Mask:
        """(h, w) True on the text of a frame. Args: index: its position in the source."""
        return text_mask(self.boxes.get(index, ()), shape)

    def painted(self, frame: StereoFrame) -> StereoFrame:
        """The frame with black in place of text, in the images of both cameras, at the same place."""
        if frame.index not in self.boxes:
            return frame
        text = self.mask(frame.index, frame.left.shape)[..., None]
        black = np.uint8(0)
        right = None if frame.right is None else np.where(text, black, frame.right)
        return replace(frame, left=np.where(text, black, frame.left), right=right)


def find_text(
    samples: Sequence[StereoFrame], frames: Callable[[], Iterable[StereoFrame]], indices: Sequence[int], view: Mask
) -> BurntInText:
    """Search a clip for burnt-in text.

    Args:
        samples: frames spread over the clip, in order.
        frames: gives all frames, in order; called only if text moves.
        indices: positions of all frames in the source, ascending.
        view: (h, w) True on the part of a source image that frames keep; text elsewhere does not count.
    """
    detector = TextDetector()

    def in_view(image: Image) -> list[TextBox]:
        return [box for box in detector.find(image) if (text_mask([box], view.shape) & view).any()]

    found = confirm([in_view(frame.left) for frame in samples])
    boxes: dict[int, list[TextBox]] = {}
    notes = []
    for text in found.static:
        first, last = text.seen[0] - 1, text.seen[-1] + 1
        low = samples[first].index if first >= 0 else -1
        high = samples[last].index if last < len(samples) else math.inf
        held = [index for index in indices if low < index < high]
        for index in held:
            boxes.setdefault(index, []).append(text.box)
        notes.append(_note("text", {index: text.box for index in held}, indices, view))
    if found.moving:
        images = (frame.left for frame in frames())
        moved = dict(zip(indices, follow(images, found.moving, detector.find), strict=True))
        for index, each in moved.items():
            boxes.setdefault(index, []).extend(each)
        if first := {index: each[0] for index, each in moved.items() if each}:
            notes.append(_note("text that moves", first, indices, view))
    more = [f"{len(notes) - MAX_NAMED} more texts"] if len(notes) > MAX_NAMED else []
    if notes:
        end = "It is masked, and black in the images. Look for text that was missed: `--blank X,Y,W,H` hides it"
        notes = [ToDo(f"burnt-in text: {'; '.join(notes[:MAX_NAMED] + more)}. {end}")]
    return BurntInText({index: each for index, each in boxes.items() if each}, notes)


def _note(what: str, boxes: dict[int, TextBox], indices: Sequence[int], view: Mask) -> str:
    """How many frames show a text, and where the first one does. Args: boxes: of the frames that show it, in order."""
    first = next(iter(boxes))
    place = ",".join(map(str, rectangle(boxes[first], view.shape)))
    return f"{what} in {len(boxes)} frames at {place} (frame {indices.index(first)} first)"
