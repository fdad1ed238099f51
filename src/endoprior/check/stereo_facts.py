"""Check the stereo pair of a sequence folder: are the cameras swapped, are the images rectified?"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from ..data import FrameSequence
from ..data.files import in_order
from ..data.images import read_color
from ..footage.stereo_order import StereoOrder, stereo_order, vertical_offset_px

COMPARED = 3
"""Number of frames to compare, evenly spaced."""


@dataclass(frozen=True)
class StereoFacts:
    """Consistency of the left and right images."""

    order: StereoOrder
    """Share of the image that matches in either order, mean over the compared frames."""
    vertical_px: float
    """Median vertical offset of matching features, px, >= 0; NaN if there are too few matches."""

    @property
    def reason(self) -> str:
        """The measurements in one line."""
        rows = f"rows {self.vertical_px:.1f} px apart" if np.isfinite(self.vertical_px) else "too few matches"
        return f"{self.order.as_given:.0%} of the image matches as given, {self.order.exchanged:.0%} swapped; {rows}"


def measure_stereo(sequence: FrameSequence) -> StereoFacts | None:
    """Compare both cameras in a few frames; None without a right image for each frame.

    Args:
        sequence: its folder may have `right/`, with one PNG for each of its frames.
    Raises:
        InputError: a right image cannot be read, or has another size.
    """
    files = in_order((sequence.path / "right").glob("*.png"))
    camera, count = sequence.camera(0), len(sequence)
    if len(files) != count or read_color(files[0]).shape[:2] != (camera.height, camera.width):
        return None  # shrunk, or only a part of the folder: the matching of images to frames is unknown
    pairs = [
        (sequence.frame(int(i)).rgb_u8, read_color(files[int(i)], (camera.width, camera.height)))
        for i in np.linspace(0, count - 1, COMPARED).round()
    ]
    orders = [stereo_order(*pair) for pair in pairs]
    offsets = [vertical_offset_px(*pair) for pair in pairs]
    known = [offset for offset in offsets if np.isfinite(offset)]
    mean = StereoOrder(*(float(np.mean([getattr(o, name) for o in orders])) for name in ("as_given", "exchanged")))
    return StereoFacts(mean, float(np.median(known)) if known else float("nan"))
