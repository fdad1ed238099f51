"""Selects which images of a video become frames: a time range at an even frame rate.

For a video of variable frame rate, each step of an even time grid takes the image that was on screen at that time. No
image is used twice: where the source has a gap, the grid step is left out and counted. Images between two steps are
left out and counted, too.
"""

from __future__ import annotations

import math
from collections.abc import Iterable, Iterator
from dataclasses import dataclass, field
from typing import Protocol, TypeVar

EVEN = 0.25
"""A time step that differs from the nominal one by more than this share is uneven."""


class Timed(Protocol):
    """An image of a source, or only its place there and its time."""

    @property
    def index(self) -> int:
        """Position in the source, from 0."""
        ...

    @property
    def seconds(self) -> float:
        """Time since the first image."""
        ...


Image = TypeVar("Image", bound=Timed)


@dataclass
class FrameSelection:
    """A time grid, and counts of gaps and uneven steps. Iterating over `pick` fills the counts."""

    frames_per_second: float
    """Rate of the grid."""
    start: float = 0.0
    """Seconds."""
    end: float = math.inf
    """Seconds; images at or after it are not used."""
    source_rate: float = 0.0
    """Nominal rate of the source, 1/s; half of its time step is the tolerance. 0 if unknown."""
    only: frozenset[int] | None = None
    """Positions in the source of the images to use, of those on the grid; None for all."""
    taken: int = field(default=0, init=False)
    gaps: int = field(default=0, init=False)
    """Grid steps without an image."""
    uneven_steps: int = field(default=0, init=False)
    """Time steps of the source that differ from the nominal one."""
    between: int = field(default=0, init=False)
    """Images within the time range that are not used."""

    def pick(self, images: Iterable[Image]) -> Iterator[Image]:
        """The images on the grid, in order; stops at `end`."""
        step = 1 / self.frames_per_second
        nominal = 1 / self.source_rate if self.source_rate else step
        tolerance = 0.5 * min(step, nominal)
        self.taken = self.gaps = self.uneven_steps = self.between = 0
        slot, before = 0, None
        for image in images:
            if image.seconds >= self.end - 1e-9:
                return
            if before is not None and abs(image.seconds - before - nominal) > EVEN * nominal:
                self.uneven_steps += 1
            before = image.seconds
            if image.seconds < self.start + slot * step - tolerance:
                self.between += image.seconds >= self.start - tolerance
                continue
            reached = max(math.floor((image.seconds - self.start + tolerance) / step + 1e-9), slot)
            self.gaps += reached - slot if self.taken else 0
            slot = reached + 1
            self.taken += 1
            if self.only is None or image.index in self.only:
                yield image
