"""A clip of one or two cameras: its video files, how the images of both cameras are stored, and the frames to use.

For a video of variable frame rate, each step of an even time grid takes the image that was on screen at that time. No
image is used twice: where the source has a gap, the grid step is left out and counted. Images between two steps are
left out and counted, too. Images of two cameras are paired by time, or by the names of their files.
"""

from __future__ import annotations

import math
from collections.abc import Iterable, Iterator
from dataclasses import dataclass, field
from pathlib import Path
from typing import NamedTuple, TypeVar

import numpy as np
from numpy.typing import NDArray

from ..core.checks import input_error
from ..core.shell import quoted
from ..data.frame_files import match_names
from ..footage.interlacing import Interlacing
from ..system.console import ToDo
from .calibration import Calibration
from .config import Layout, PrepareConfig
from .frame_geometry import MIN_SIDE_PX
from .source import ImageFolder, Source, open_source
from .stereo_layout import KINDS, NUM_SAMPLE_IMAGES, camera_size, find_layout, split_cameras
from .video import SourceFrame, Video

EVEN = 0.25  # a time step that differs from the nominal one by more than this share is uneven
SAME_CLOCK_S = 1.0  # arbitrary clocks are one clock if they start closer together than this
Image = NDArray[np.uint8]


class Moment(NamedTuple):
    """Place and time of an image."""

    index: int
    seconds: float


Item = TypeVar("Item", Moment, "StereoFrame", SourceFrame)


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

    def pick(self, images: Iterable[Item]) -> Iterator[Item]:
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


@dataclass(frozen=True)
class StereoFrame:
    """The images of both cameras at one time, as stored in the source."""

    index: int  # position of the frame in the source, from 0
    seconds: float  # since the first image
    left: Image  # (h, w, 3)
    right: Image | None  # (h, w, 3); None if the video is monocular
    damaged: bool = False  # bytes of one of them, or of what it was predicted from, are missing or wrong

    @property
    def nbytes(self) -> int:
        """Memory that the images take."""
        return self.left.nbytes + (0 if self.right is None else self.right.nbytes)


class Clip:
    """Video files and their layout. `stereo_frames` can be iterated any number of times."""

    def __init__(self, video: Path, cfg: PrepareConfig, calibration: Calibration | None) -> None:
        """Open the files and detect the layout; raises InputError if a file cannot be used."""
        self._cfg, self.swap = cfg, cfg.swap_eyes
        self.source: Source = open_source(video, cfg.folder_rate)
        of_first = self.source.frames_per_second if isinstance(self.source, ImageFolder) else None
        second = open_source(cfg.right, cfg.folder_rate or of_first) if cfg.right else None
        self._sources = [self.source, *([second] if second else [])]
        width, height = self.source.width, self.source.height
        if min(width, height) < MIN_SIDE_PX:
            got = f"{width}x{height}"
            raise input_error(video, f"images of at least {MIN_SIDE_PX}x{MIN_SIDE_PX} px", got, "Give the full size.")
        self.calibration, self._rescaled = _of_square_pixels(calibration, self.source)
        self.layout: Layout = cfg.layout
        if second is not None and cfg.layout in KINDS:
            fix = "Remove one of both options."
            raise input_error("--layout", "auto or two-files with --right", cfg.layout, fix)
        if cfg.layout == "auto":
            images = self.source.sample_images(cfg.start, cfg.end, NUM_SAMPLE_IMAGES)
            self.layout = find_layout(images, self.calibration, second is not None, str(video))
        if self.layout == "two-files" and second is None:
            raise input_error("--layout two-files", "a second video", "none", "`--right VIDEO`.")
        if second is not None and (second.width, second.height) != (width, height):
            got, want = f"{second.width}x{second.height}", f"{width}x{height} px like {video}"
            raise input_error(str(cfg.right), want, got, "Pass the two videos of one recording.")
        if self.layout == "interlaced" and isinstance(self.source, Video):
            self.source.weave = True
        self.stereo = self.layout != "mono"
        self.camera_size = camera_size(width, height, self.layout)
        self._pairing = Pairing(self.source, second) if second else None
        self._rate = self._pairing.rate if self._pairing else self.source.frames_per_second
        self.frames_per_second = cfg.frames_per_second or self._rate
        self._unpaired = 0  # images of the first video, in the last iteration, without one of the second at their time
        self._interlacing = Interlacing()  # what tells, in the last iteration, that rows are of two times
        self.only: frozenset[int] | None = None
        """Positions in the source of the frames to use, of those selected; None for all."""

    @property
    def was_damaged(self) -> bool:
        """Whether an iteration has met damaged images."""
        return any(source.was_damaged for source in self._sources)

    @property
    def notes(self) -> list[str]:
        """What is particular about the video files, one line each, after a complete iteration."""
        notes = [note for source in self._sources for note in source.notes]
        if self._rescaled:
            notes.append("the calibration belongs to the stored pixels, which are not square; it is scaled with them")
        if self._interlacing.is_certain:
            notes.append(_comb_note(self.source))
        if self._pairing and self._pairing.note:
            notes.append(self._pairing.note)
        if self._unpaired:
            name = self.source.path.name
            notes.append(f"{name}: {self._unpaired} images have none of the second camera and are left out")
        return notes

    @property
    def stored_size(self) -> tuple[int, int] | None:
        """(width, height) of one camera's image before its pixels became square, px; None if they were."""
        if not isinstance(self.source, Video) or self.source.pixel_aspect == 1:
            return None
        return camera_size(*self.source.stored_size, self.layout)

    def selection(self) -> FrameSelection:
        """The frames to use, with all counts at zero."""
        return FrameSelection(self.frames_per_second, self._cfg.start, self._cfg.end, self._rate, self.only)

    def stereo_frames(self, selection: FrameSelection) -> Iterator[StereoFrame]:
        """The selected frames, in order. Of two files, only images that both have at one time.

        Raises:
            InputError: a file is damaged, or the two videos have no time in common.
        """
        yield from selection.pick(self._all_frames())
        if self._pairing and not selection.taken:
            fix, want = "Pass the two videos of one recording.", f"images at the times of {self.source.path}"
            raise input_error(self._sources[1].path, want, "none", fix)

    def _all_frames(self) -> Iterator[StereoFrame]:
        self._interlacing = Interlacing()
        if self._pairing is None:
            for image in self.source:
                self._look_at_rows(image)
                yield self._stereo_frame(image, *split_cameras(image.rgb_u8, self.layout))
            return
        self._unpaired = 0
        for image, other in self._pairing:
            self._look_at_rows(image)
            if other is None:
                self._unpaired += self._cfg.start <= image.seconds < self._cfg.end
            else:
                yield self._stereo_frame(image, image.rgb_u8, other.rgb_u8, other.damaged)

    def _look_at_rows(self, image: SourceFrame) -> None:
        if self.layout != "interlaced" and self._cfg.start <= image.seconds < self._cfg.end:
            self._interlacing.see(image.rgb_u8)

    def _stereo_frame(
        self, image: SourceFrame, first: Image, second: Image | None, damaged: bool = False
    ) -> StereoFrame:
        if self.swap and second is not None:
            first, second = second, first
        return StereoFrame(image.index, image.seconds, first, second, damaged or image.damaged)


def _comb_note(source: Source) -> str:
    """That images of a progressive video have rows of two times, and the command that helps."""
    path, fix = source.path, "deinterlace the video before its images are exported"
    if not isinstance(source, ImageFolder):
        even = path.with_name(f"{path.stem}_progressive.mp4")
        words = ["ffmpeg", "-i", path, "-vf", "bwdif=deint=all", "-crf", "10", even]
        fix = f"`{' '.join(map(quoted, words))}`"
    return ToDo(f"{path.name}: rows alternate where something moves, as in interlaced video. Fix: {fix}")


def _of_square_pixels(calibration: Calibration | None, source: Source) -> tuple[Calibration | None, bool]:
    """A calibration for images of square pixels, and whether it was made of the stored pixels of the source.

    Stored pixels that are w wide and 1 high have a focal length of fx = fy / w; square ones have fx = fy.
    """
    aspect = float(source.pixel_aspect) if isinstance(source, Video) else 1.0
    if calibration is None or aspect == 1:
        return calibration, False
    focal = np.log(calibration.left.matrix[0, 0] / calibration.left.matrix[1, 1])
    if abs(focal) < abs(focal + np.log(aspect)):
        return calibration, False
    size = calibration.size and (round(calibration.size[0] * aspect), calibration.size[1])
    return calibration.scaled(aspect, 1.0, size), True
