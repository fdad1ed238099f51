"""Which image of the second camera belongs to an image of the first: by time, or by the names of files."""

from __future__ import annotations

from collections.abc import Iterable, Iterator
from dataclasses import dataclass

from ..data.frame_files import match_names
from .image_folder import ImageFolder
from .source import Source
from .source_frame import SourceFrame

SAME_CLOCK_S = 1.0
"""Recordings whose clocks do not count from their starts have one clock if they start closer together than this."""


@dataclass(frozen=True)
class Pairing:
    """How the images of two sources are paired."""

    offset: float
    """Time of the first image of the second source, s since that of the first source."""
    rate: float
    """Usual rate of the pairs, 1/s."""
    by_name: dict[int, int] | None
    """Position in the second folder for a position in the first one; None: by time."""
    note: str
    """What is particular, one line; else empty."""

    def pairs(self, first: Source, second: Source) -> Iterator[tuple[SourceFrame, SourceFrame | None]]:
        """Each image of the first source, with that of the second source at the same time, if there is one."""
        if self.by_name is None:
            tolerance = 0.5 * min(1 / first.frames_per_second, 1 / second.frames_per_second)
            yield from pair_by_time(first, second, self.offset, tolerance)
            return
        assert isinstance(second, ImageFolder)
        for image in first:
            other = self.by_name.get(image.index)
            yield image, None if other is None else second.image(other)


def find_pairing(first: Source, second: Source) -> Pairing:
    """How to pair the images of two opened sources."""
    rate, name = min(first.frames_per_second, second.frames_per_second), second.path.name
    if isinstance(first, ImageFolder) and isinstance(second, ImageFolder):
        names = [file.name for file in second.files], [file.stem for file in first.files]
        matched = match_names(second.path, names[0], range(len(names[1])), names[1], required=())
        unused = len(names[0]) - len(matched.files)
        notes = [matched.rule] if "in order" in matched.rule else []
        notes += [f"{unused} images have none of the first camera and are left out"] if unused else []
        return Pairing(0.0, rate, matched.files, f"{name}: {'; '.join(notes)}" if notes else "")
    offset, notes = second.start - first.start, []
    arbitrary = any(getattr(each, "clock_is_arbitrary", False) for each in (first, second))
    if arbitrary and abs(offset) > SAME_CLOCK_S:
        offset = 0.0
        notes.append("its clock differs from that of the first video; their first images are taken as simultaneous")
    step = 1 / max(first.frames_per_second, second.frames_per_second)
    if abs(offset) > step / 2:
        when = "after" if offset > 0 else "before"
        notes.append(f"by its time stamps it starts {abs(offset):.3g} s {when} the first video")
    if abs(second.frames_per_second / first.frames_per_second - 1) > 0.01:
        rates = f"{second.frames_per_second:.4g} images per second, the first video {first.frames_per_second:.4g}"
        notes.append(f"it has {rates}; images are paired by time")
    ends_apart = second.seconds + offset - first.seconds
    if abs(ends_apart) > 1.5 * step and second.seconds:
        notes.append(f"it ends {abs(ends_apart):.3g} s {'after' if ends_apart > 0 else 'before'} the first video")
    return Pairing(offset, rate, None, f"{name}: {'; '.join(notes)}" if notes else "")


def pair_by_time(
    firsts: Iterable[SourceFrame], seconds: Iterable[SourceFrame], offset: float, tolerance: float
) -> Iterator[tuple[SourceFrame, SourceFrame | None]]:
    """Each first image with the second image nearest in time, or None.

    Args:
        offset: added to the times of the second images, s.
        tolerance: largest difference in time, s. No second image is used twice.
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
