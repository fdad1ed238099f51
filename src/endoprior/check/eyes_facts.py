"""The right eye of a sequence folder, where it has one: are the eyes swapped, and on one height?"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from ..data import FrameSequence
from ..data.files import natural_order
from ..data.images import read_color
from ..footage.eyes import EyeOrder, eye_order, vertical_offset_px

COMPARED = 3
"""Frames that are compared, evenly spread."""


@dataclass(frozen=True)
class EyeFacts:
    """How the right eye's pictures go with the left eye's."""

    order: EyeOrder
    """How much of the picture either order explains, mean over the frames compared."""
    vertical_px: float
    """Median distance of the same thing's rows in both pictures, px, >= 0; NaN where too little matches."""

    @property
    def reason(self) -> str:
        """The evidence in one line."""
        rows = f"rows {self.vertical_px:.1f} px apart" if np.isfinite(self.vertical_px) else "too little matches"
        explained = f"{self.order.as_given:.0%} of the picture as it is and {self.order.exchanged:.0%} exchanged"
        return f"the eyes explain {explained}; {rows}"


def measure_eyes(sequence: FrameSequence) -> EyeFacts | None:
    """Compare both eyes in a few frames; None where the folder has no right eye, or not one picture per frame.

    Args:
        sequence: its folder may have `right/`, with one PNG for each of its frames.
    Raises:
        InputError: a picture of the right eye cannot be read, or has another size.
    """
    files = sorted((sequence.path / "right").glob("*.png"), key=natural_order)
    camera, count = sequence.camera(0), len(sequence)
    if len(files) != count or read_color(files[0]).shape[:2] != (camera.height, camera.width):
        return None  # shrunk, or only a part of the folder: which picture belongs to which frame is not known here
    pairs = [
        (sequence.frame(int(i)).rgb_u8, read_color(files[int(i)], (camera.width, camera.height)))
        for i in np.linspace(0, count - 1, COMPARED).round()
    ]
    orders = [eye_order(*pair) for pair in pairs]
    offsets = [vertical_offset_px(*pair) for pair in pairs]
    known = [offset for offset in offsets if np.isfinite(offset)]
    mean = EyeOrder(*(float(np.mean([getattr(o, name) for o in orders])) for name in ("as_given", "exchanged")))
    return EyeFacts(mean, float(np.median(known)) if known else float("nan"))
