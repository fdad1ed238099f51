"""Optical flow between an anchor frame and every frame around it, both ways.

Chained from frame to frame, flow drifts. The flow straight from the anchor to a distant frame does not; it is found
because its search starts from the flow to the frame between. `T` frames, `h, w` size of the gray images.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import cv2
import numpy as np
from numpy.typing import NDArray

from ..footage.optical_flow import fine_flow

SPACING = 12
"""Largest number of frames between two anchors. With 6 the tracks of the phantoms are no better."""
LEAST_ANCHORS = 4
"""Also of a short sequence: a point that is hidden in one anchor is followed by way of another."""
REACH = 48
"""Frames to both sides of an anchor to which flow is computed."""
Flow = NDArray[np.float16]
"""(h, w, 2) px of the gray images. Half precision: 0.01 px at 30 px, and all flows of an anchor fit in memory."""


@dataclass(frozen=True)
class AnchorFlow:
    """The flows between one anchor and the frames around it."""

    anchor: int
    there: dict[int, Flow]
    """By frame: flow from the anchor to it."""
    back: dict[int, Flow]
    """By frame: flow from it to the anchor."""


def anchors(count: int) -> list[int]:
    """Positions of the anchors among `count` frames: the middles of equal parts of at most `SPACING` frames."""
    parts = max(-(-count // SPACING), min(count, LEAST_ANCHORS))
    return [int((i + 0.5) * count / parts) for i in range(parts)]


def neighbor_flows(grays: Sequence[NDArray[np.uint8]], k: int) -> tuple[Flow, Flow]:
    """Flow from image `k` to the next one, and back."""
    first, second = grays[k], grays[k + 1]
    return fine_flow(first, second).astype(np.float16), fine_flow(second, first).astype(np.float16)


def anchor_flow(grays: Sequence[NDArray[np.uint8]], neighbors: Sequence[tuple[Flow, Flow]], anchor: int) -> AnchorFlow:
    """The flows between image `anchor` and those up to `REACH` from it.

    Args:
        grays: T gray images. neighbors: T - 1 results of `neighbor_flows`.
    """
    still = np.zeros((*grays[0].shape, 2), np.float16)
    there, back = {anchor: still}, {anchor: still}
    for last, step in ((min(anchor + REACH, len(grays) - 1), 1), (max(anchor - REACH, 0), -1)):
        for k in range(anchor, last, step):
            onward, returning = neighbors[k] if step > 0 else neighbors[k - 1][::-1]
            guess_there, guess_back = _composed(there[k], onward), _composed(returning, back[k])
            there[k + step] = fine_flow(grays[anchor], grays[k + step], guess_there).astype(np.float16)
            back[k + step] = fine_flow(grays[k + step], grays[anchor], guess_back).astype(np.float16)
    return AnchorFlow(anchor, there, back)


def _composed(first: Flow, second: Flow) -> NDArray[np.float32]:
    """(h, w, 2) flow that goes along `first` and from there along `second`."""
    first, second = first.astype(np.float32), second.astype(np.float32)
    row, column = np.mgrid[: first.shape[0], : first.shape[1]].astype(np.float32)
    x, y = column + first[..., 0], row + first[..., 1]
    return first + cv2.remap(second, x, y, cv2.INTER_LINEAR, borderMode=cv2.BORDER_REPLICATE)
