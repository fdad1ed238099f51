"""Which pictures of a clip become frames: a time range, an even rate, as many as asked for.

A clip of variable frame rate is brought to an even one by taking, for each moment of an even grid, the picture that
was on screen then; a picture is never taken twice, so gaps of the source stay gaps and are counted.
"""

from __future__ import annotations

import math
from collections.abc import Iterable, Iterator
from dataclasses import dataclass, field

from .source import Picture

EVEN = 0.25
"""Steps between pictures that differ from their median by more than this share make the rate variable."""


@dataclass
class Selection:
    """A grid of moments, and what was found on it; iterate over `pick` to fill the counts."""

    frames_per_second: float
    """Of the grid."""
    start: float = 0.0
    """Seconds."""
    end: float = math.inf
    """Seconds; pictures at or after it are left out."""
    source_rate: float = 0.0
    """Nominal rate of the source, 1/s: half of its step is the tolerance for "on time"; 0 for none."""
    taken: int = field(default=0, init=False)
    gaps: int = field(default=0, init=False)
    """Moments of the grid without a picture of their own."""
    uneven_steps: int = field(default=0, init=False)
    """Steps of the source that differ from its nominal one."""

    def pick(self, pictures: Iterable[Picture]) -> Iterator[Picture]:
        """The pictures of the grid, in order; stops as soon as `end` is passed."""
        step = 1 / self.frames_per_second
        nominal = 1 / self.source_rate if self.source_rate else step
        tolerance = 0.5 * min(step, nominal)
        self.taken = self.gaps = self.uneven_steps = 0
        slot, before = 0, None
        for picture in pictures:
            if picture.seconds >= self.end - 1e-9:
                return
            if before is not None and abs(picture.seconds - before - nominal) > EVEN * nominal:
                self.uneven_steps += 1
            before = picture.seconds
            if picture.seconds < self.start + slot * step - tolerance:
                continue
            reached = max(math.floor((picture.seconds - self.start + tolerance) / step + 1e-9), slot)
            self.gaps += reached - slot if self.taken else 0
            slot = reached + 1
            self.taken += 1
            yield picture
