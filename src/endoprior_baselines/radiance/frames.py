"""Training frames as rays: which pixels are drawn, how often, and what they show.

A pixel is drawn with probability ~ M (1 + p): M is 1 where it may be drawn, and p is how often tools hide it, over the
Euclidean norm of that count over all pixels (EndoNeRF's tool-guided sampling). Tissue that is seldom seen counts more.
"""

from __future__ import annotations

from functools import cached_property

import numpy as np
from numpy.typing import NDArray

from endoprior.core.checks import input_error
from endoprior.core.geometry import FARTHEST_MM
from endoprior.core.types import Camera, Frame
from endoprior.data import FrameSequence

MOST_DEPTHS = 2**22
"""Depths over which percentiles are taken, about: evenly spaced pixels of all frames."""


class RayFrames:
    """The training frames of a sequence by position, 0 to len - 1."""

    def __init__(self, sequence: FrameSequence, *, only_measured: bool) -> None:
        """Args: only_measured: draw pixels with a depth only."""
        self.sequence, self.only_measured = sequence, only_measured
        self.indices = sequence.indices("train")

    def __len__(self) -> int:
        return len(self.indices)

    def frame(self, position: int) -> Frame:
        """Training frame number `position`."""
        return self.sequence.frame(self.indices[position])

    @property
    def camera(self) -> Camera:
        """Camera of the first training frame: the one that a field may refer to."""
        return self.sequence.camera(self.indices[0])

    @cached_property
    def boost(self) -> NDArray[np.float32]:
        """(H * W,) p of each pixel."""
        hidden = sum((~self.frame(k).tissue_mask).astype(np.float32) for k in range(len(self)))
        norm = float(np.linalg.norm(hidden))
        return (hidden / norm if norm else hidden).ravel()

    @cached_property
    def usable(self) -> list[int]:
        """Positions of frames from which a pixel can be drawn.

        Raises:
            InputError: there is none.
        """
        found = [k for k in range(len(self)) if self._drawable(k).any()]
        if not found:
            what = "tissue with depth" if self.only_measured else "tissue"
            fix = "the mask's polarity may be inverted: masks are 255 on tools."
            raise input_error(self.sequence.path, f"{what} in a training frame", "none", fix)
        return found

    def _drawable(self, position: int) -> NDArray[np.bool_]:
        frame = self.frame(position)
        return measured(frame) if self.only_measured else frame.tissue_mask

    def draw(self, position: int, num: int, rng: np.random.Generator) -> NDArray[np.intp]:
        """`num` pixels of a usable frame, row * width + column, with replacement."""
        until = np.cumsum(self._drawable(position).ravel() * (1 + self.boost), dtype=np.float64)
        found = np.searchsorted(until, rng.random(num) * until[-1], side="right")
        return np.minimum(found, np.searchsorted(until, until[-1]))  # rounding must not lead behind the last one

    def depth(self, position: int) -> NDArray[np.float32]:
        """(H, W) z of the surface, mm; 0 where tissue has no depth."""
        frame = self.frame(position)
        return np.where(measured(frame), frame.depth, np.float32(0))

    def depth_percentiles(self, low: float, high: float, *, missing: bool) -> tuple[float, float]:
        """Percentiles of the depths of all training frames, mm; 0 without any depth.

        Args:
            missing: a missing depth counts as 0; else it does not count.
        """
        every = max(1, len(self) * self.camera.width * self.camera.height // MOST_DEPTHS)
        depths = np.concatenate([self.depth(k).ravel()[::every] for k in range(len(self))])
        depths = depths if missing else depths[depths > 0]
        first, last = np.percentile(depths, (low, high)) if depths.size else (0.0, 0.0)
        return float(first), float(last)


def measured(frame: Frame) -> NDArray[np.bool_]:
    """(H, W) where tissue has a usable depth."""
    return frame.tissue_mask & frame.depth_valid & (frame.depth > 0) & (frame.depth < FARTHEST_MM)  # NaN fails too
