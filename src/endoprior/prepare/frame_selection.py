"""Which images of one or two sources become frames: a time range at an even frame rate, and pairs of one time.

For a video of variable frame rate, each step of an even time grid takes the image that was on screen at that time. No
image is used twice: where the source has a gap, the grid step is left out and counted. Images between two steps are
left out and counted, too. Images of two cameras are paired by time, or by the names of their files.
"""

from __future__ import annotations

import math
from collections.abc import Iterable, Iterator
from dataclasses import dataclass, field
from typing import NamedTuple, Protocol, TypeVar

from ..data.frame_files import match_names
from .source import ImageFolder, Source
from .video import SourceFrame

EVEN = 0.25  # a time step that differs from the nominal one by more than this share is uneven
SAME_CLOCK_S = 1.0  # arbitrary clocks are one clock if they start closer together than this


class Timed(Protocol):
    """An image of a source: its position there, from 0, and its time since the first image."""

    @property
    def index(self) -> int: ...
    @property
    def seconds(self) -> float: ...


class Moment(NamedTuple):
    """Place and time of an image."""

    index: int
    seconds: float


Image = TypeVar("Image", bound=Timed)


@dataclass
class FrameSelection:
    """A time grid, and counts of gaps and uneven steps. Iterating over `pick` fills the counts."""

    frames_per_second: float  # rate of the grid
    start: float = 0.0  # seconds
    end: float = math.inf  # seconds; images at or after it are not used
    source_rate: float = 0.0  # nominal rate of the source, 1/s; half of its time step is the tolerance. 0 if unknown.
    only: frozenset[int] | None = None  # positions in the source of the images to use, of those on the grid; None: all
    taken: int = field(default=0, init=False)
    gaps: int = field(default=0, init=False)  # grid steps without an image
    uneven_steps: int = field(default=0, init=False)  # time steps of the source that differ from the nominal one
    between: int = field(default=0, init=False)  # images within the time range that are not used

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
            self.uneven_steps += before is not None and abs(image.seconds - before - nominal) > EVEN * nominal
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


class Pairing:
    """How the images of two sources are paired: those of folders by name, others by time."""

    def __init__(self, first: Source, second: Source) -> None:
        self._first, self._second = first, second
        self._offset = 0.0  # time of the first image of the second source, s since that of the first source
        self._by_name: dict[int, int] = {}  # position in the second folder for a position in the first one
        self.rate = min(first.frames_per_second, second.frames_per_second)
        if isinstance(first, ImageFolder) and isinstance(second, ImageFolder):
            names = [file.name for file in second.files], [file.stem for file in first.files]
            matched = match_names(second.path, names[0], range(len(names[1])), names[1], required=())
            self._by_name, unused = matched.files, len(names[0]) - len(matched.files)
            notes = [matched.rule] if "in order" in matched.rule else []
            notes += [f"{unused} images have none of the first camera and are left out"] if unused else []
        else:
            self._offset, notes = _offset(first, second)
        self.note = f"{second.path.name}: {'; '.join(notes)}" if notes else ""  # what is particular, or empty

    def __iter__(self) -> Iterator[tuple[SourceFrame, SourceFrame | None]]:
        """Each image of the first source, with that of the second source at the same time, if there is one."""
        first, second = self._first, self._second
        if isinstance(first, ImageFolder) and isinstance(second, ImageFolder):
            for image in first:
                other = self._by_name.get(image.index)
                yield image, None if other is None else second.image(other)
        else:
            tolerance = 0.5 * min(1 / first.frames_per_second, 1 / second.frames_per_second)
            yield from pair_by_time(first, second, self._offset, tolerance)


def _offset(first: Source, second: Source) -> tuple[float, list[str]]:
    """Time of the first image of the second source, s since that of the first source; and what is particular."""
    offset, notes = second.start - first.start, []
    if (first.clock_is_arbitrary or second.clock_is_arbitrary) and abs(offset) > SAME_CLOCK_S:
        offset = 0.0
        notes.append("its clock differs from that of the first video; their first images are taken as simultaneous")
    step = 1 / max(first.frames_per_second, second.frames_per_second)

    def beside(seconds: float) -> str:
        return f"{abs(seconds):.3g} s {'after' if seconds > 0 else 'before'} the first video"

    if abs(offset) > step / 2:
        notes.append(f"by its time stamps it starts {beside(offset)}")
    if abs(second.frames_per_second / first.frames_per_second - 1) > 0.01:
        rates = f"{second.frames_per_second:.4g} images per second, the first video {first.frames_per_second:.4g}"
        notes.append(f"it has {rates}; images are paired by time")
    ends_apart = second.seconds + offset - first.seconds
    if abs(ends_apart) > 1.5 * step and second.seconds:
        notes.append(f"it ends {beside(ends_apart)}")
    return offset, notes


def pair_by_time(
    firsts: Iterable[SourceFrame], seconds: Iterable[SourceFrame], offset: float, tolerance: float
) -> Iterator[tuple[SourceFrame, SourceFrame | None]]:
    """Each first image with the second image nearest in time, or None; none is used twice.

    Args:
        offset: added to the times of the second images, s.
        tolerance: largest difference in time, s.
    """
    others = _in_order(seconds)
    now, following = next(others, None), next(others, None)
    used = -1
    for image in firsts:
        time = image.seconds - offset
        while now and following and abs(following.seconds - time) <= abs(now.seconds - time):
            now, following = following, next(others, None)
        if now and now.index != used and abs(now.seconds - time) <= tolerance + 1e-6:
            used = now.index
            yield image, now
        else:
            yield image, None


def _in_order(images: Iterable[SourceFrame]) -> Iterator[SourceFrame]:
    """Those images whose time is after that of all before."""
    last = float("-inf")
    for image in images:
        if image.seconds > last:
            last = image.seconds
            yield image
