"""Carry masks from one frame over the frames that follow, in chunks, so that memory does not grow with the clip.

`H, W` image size. The order of the frames is the direction: forward or backward in time.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from typing import Protocol

import numpy as np
from numpy.typing import NDArray

CHUNK = 24
"""Frames that a segmenter remembers at a time. SAM 2 keeps 13 MB per frame, and 6 MB per frame and object."""
PATIENCE = 25
"""After so many frames without any of the objects the rest is left: what enters later has prompts of its own."""
Mask = NDArray[np.bool_]


class Chunk(Protocol):
    """What a segmenter remembers of a few successive frames."""

    def show(self, rgb_u8: NDArray[np.uint8], masks: Sequence[Mask]) -> None:
        """Give a frame (H, W, 3) whose objects are known: (H, W) each, empty for one that is out of view."""

    def follow(self, rgb_u8: NDArray[np.uint8]) -> list[Mask]:
        """The same objects in the next frame (H, W, 3): (H, W) each."""


class VideoSegmenter(Protocol):
    """A network that follows objects through a video."""

    name: str
    """For the user: `SAM 2 (facebook/...)`."""

    def begin(self) -> Chunk:
        """A new chunk that remembers nothing."""


def carry(
    segmenter: VideoSegmenter,
    frame: Callable[[int], NDArray[np.uint8]],
    order: Sequence[int],
    regions: Sequence[Mask],
) -> Iterator[tuple[int, Mask]]:
    """Carry regions of the first frame over the others, until all of them are out of view for `PATIENCE` frames.

    Every chunk sees the first frame again, where the objects are surely right, and the last frame of the chunk before.

    Args:
        frame: decodes a frame, (H, W, 3) 0..255; called in this order, and for few frames twice.
        order: frames to go through; the regions belong to the first.
        regions: (H, W) each, one per object.
    Yields:
        Each frame but the first, and (H, W) True on any of the objects.
    """
    masks, chunk, empty = list(regions), None, 0
    for count, index in enumerate(order[1:]):
        if count % CHUNK == 0:
            chunk = segmenter.begin()
            chunk.show(frame(order[0]), regions)
            if count:
                chunk.show(frame(order[count]), masks)
        masks = chunk.follow(frame(index))
        union = np.any(masks, axis=0)
        empty = 0 if union.any() else empty + 1
        yield index, union
        if empty == PATIENCE:
            return
