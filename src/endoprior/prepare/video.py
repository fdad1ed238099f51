"""A video file as a source: decoded by FFmpeg through PyAV, upright, of square pixels, in the order of display."""

from __future__ import annotations

import errno
from bisect import bisect_left
from collections.abc import Callable, Iterator
from contextlib import contextmanager, suppress
from dataclasses import dataclass
from fractions import Fraction
from functools import partial
from itertools import islice
from pathlib import Path

import av
import cv2
import numpy as np
from av.container import InputContainer
from av.error import FFmpegError
from av.video.stream import VideoStream
from numpy.typing import NDArray

from ..core.checks import input_error
from ..core.shell import quoted
from ..data.images import MIRRORED, TURNED, upright
from ..data.pixels import is_matte
from ..data.reading import MAX_PIXELS
from ..data.video_files import open_container, starts_of_parts, what_it_is
from ..system.console import ToDo
from .decoding import AVI, DecodedImage, Timeline, choose_track, decode, in_seconds, is_cover, packet_times, usual_rate

LOST_SHARE, LOST_IMAGES = 0.02, 2  # truncated: more of the duration, and more images, are missing at the end
STATES_END = ("matroska,webm", "nut")
"""FFmpeg's names of the formats whose duration is the time of the end, however late the first image is shown."""
ARBITRARY_CLOCKS = ("mpegts", "mpeg")  # formats whose times do not count from the start of the recording
PIXEL_ASPECTS = (0.25, 4.0)  # plausible width of a pixel, in heights
LOOKED_AT = 300  # most images that are decoded to reach a time: as many as between two key frames
SmallImage = Callable[..., NDArray[np.uint8]]
"""Called with a width and a height, px: the image (h, w, 3) of that size, or (h, w) gray values with `is_gray`."""
HIGH_RANGE = {16: ("PQ", "smpte2084"), 18: ("HLG", "arib-std-b67")}
"""Transfer characteristics of HDR video by their number in ITU-T H.273: what they are called, and by FFmpeg."""
COPY_AGAIN = "Copy or export it again."


@dataclass(frozen=True)
class SourceFrame:
    """One image of a source."""

    index: int  # position in the source, from 0
    seconds: float  # since the first image; may be before that of the image before, if the file is in disorder
    rgb_u8: NDArray[np.uint8]  # (H, W, 3) of square pixels
    damaged: bool = False  # bytes of it, or of an image that it was predicted from, are missing or wrong


class Video:
    """A video file. Metadata (names, dates, places) is not read."""

    weave: bool = False  # keep the rows of interlaced images as they are: they are those of two cameras
    was_damaged: bool = False  # an iteration has met damage: from then on, one thread decodes, which reports all damage

    def __init__(self, path: Path) -> None:
        """Open the file and decode the first image; raises InputError if that fails."""
        self.path, self.start = path, 0.0
        self._size = (0, 0)
        self._found: list[str] = []
        self._transfer = 0  # of the levels, by its number in ITU-T H.273; some files tell it with their images only
        if path.stat().st_size == 0:
            raise input_error(path, "a video file", "an empty file", "Copy it again.")
        with self._open() as (container, track):
            stated = [float(rate) for rate in (track.average_rate, track.guessed_rate) if rate]
            packets, end = packet_times(container, track)
            self.frames_per_second = usual_rate([time for time in packets if time is not None], stated)
            self._step = 1 / self.frames_per_second
            times = [time for _, time in Timeline(self._step).along((None, time) for time in packets)]
            self.times = sorted(time - times[0] for time in times)
            """Time of each image since the first one, s, before any is decoded."""
            self.num_frames = max(int(track.frames), 0)
            aspect = track.sample_aspect_ratio or Fraction(1)
            self._aspect = aspect if PIXEL_ASPECTS[0] <= aspect <= PIXEL_ASPECTS[1] else Fraction(0)
            unread = _unread_parts(path, container.format.name, end)
            self._of_file = [*_other_tracks(path.absolute(), container, track), *unread]
            # The duration may be that of all parts.
            self._announced_end = 0.0 if unread else _announced_end(container, track)
            self.clock_is_arbitrary = container.format.name in ARBITRARY_CLOCKS
        first = next(iter(self), None)
        if first is None:
            want = f"a video with images of at most {MAX_PIXELS // 1_000_000} Mpx"
            raise input_error(path, want, "none that can be decoded", COPY_AGAIN)
        self.height, self.width = first.rgb_u8.shape[:2]
        lasts = max(self._announced_end - self.start, 0.0)
        self.seconds = max(lasts, self.times[-1] + self._step if self.times else 0.0)

    @property
    def pixel_aspect(self) -> Fraction:
        """Width of a stored pixel divided by its height. The images of the source have square pixels."""
        return self._aspect if self._shown_width(self._size[0]) != self._size[0] else Fraction(1)

    @property
    def stored_size(self) -> tuple[int, int]:
        """(width, height) of an upright image before its pixels become square, px."""
        width, height = self._size
        return (width, height) if self.height == height else (height, width)

    @property
    def notes(self) -> list[str]:
        """What is particular about the file, one line each; of its images after a complete iteration."""
        notes, (width, height) = list(self._of_file), self._size
        if self.pixel_aspect != 1:
            aspect, shown = f"{self._aspect.numerator}:{self._aspect.denominator}", self._shown_width(width)
            notes.append(
                self._note(f"pixels are not square ({aspect}); {width}x{height} px become {shown}x{height} px")
            )
        elif self._aspect == 0:
            notes.append(self._note("the stated aspect ratio of pixels is not plausible and is ignored"))
        return notes + _of_high_range(self.path, self._transfer) + self._found

    def _note(self, words: str) -> str:
        return f"{self.path.name}: {words}"

    def __iter__(self) -> Iterator[SourceFrame]:
        timeline, lost, broken = Timeline(self._step), [], ""
        began, last, shown_until = None, 0.0, 0.0
        index = interlaced = mirrored = see_through = 0
        with self._open() as (container, track):
            try:
                images = decode(container, track, lost, one_thread=self.was_damaged, weave=self.weave)
                for image, seconds in timeline.along((image, image.seconds) for image in images):
                    began = self.start = seconds if began is None else began
                    self._transfer = image.frame.color_trc
                    last = max(last, seconds)
                    own = float((image.frame.duration or 0) * (image.frame.time_base or 0))
                    shown_until = max(shown_until, seconds + max(self._step, own))
                    interlaced += image.interlaced
                    mirrored += image.orientation in MIRRORED
                    see_through += _is_transparent(image.frame)
                    self.was_damaged |= image.damaged
                    yield SourceFrame(index, seconds - began, self._rgb(image, index), image.damaged)
                    index += 1
            except FFmpegError as error:
                broken = error.strerror or str(error)
        self.was_damaged |= bool(lost)
        nothing_decodes = bool(self.times) and not index
        self._found = [] if nothing_decodes else self._check_end(index, began or 0.0, last, shown_until, broken)
        parts, is_filled = f"{timeline.restarts + 1} parts", interlaced and not self.weave
        particular = {
            f"damaged images that cannot be decoded and are left out: {len(lost)}": lost,
            f"joined of {parts}, each with times of its own; they follow each other": timeline.restarts,
            f"{timeline.repeated} time stamps repeat the one before; such images are spread in time": timeline.repeated,
            f"times in disorder, images that are shown too late: {timeline.misplaced}": timeline.misplaced,
            transparent(see_through): see_through,
            f"{mirrored} images are stored mirrored; they are used as the file says that they are shown": mirrored,
            f"{interlaced} images are interlaced; one field of each is used, with its rows filled": is_filled,
        }
        self._found += [self._note(words) for words, is_so in particular.items() if is_so]

    def quick_images(self) -> Iterator[tuple[float, SmallImage]]:
        """Times of the images, s, and functions that give one small; for a first look.

        Images that no other one is predicted from are left out, and blocks are not smoothed: up to four times faster.
        Stops where the file cannot be read on.
        """
        timeline, began = Timeline(self._step), None
        with self._open() as (container, track):
            if container.format.name != AVI:  # there, images get their times by counting
                track.codec_context.skip_frame = "NONREF"
            track.codec_context.options |= {"skip_loop_filter": "all"}
            with suppress(FFmpegError):
                images = decode(container, track, [], weave=True)
                for image, seconds in timeline.along((image, image.seconds) for image in images):
                    began = seconds if began is None else began
                    yield seconds - began, partial(_small, image)

    def sample_images(self, start: float, end: float, count: int) -> list[NDArray[np.uint8]]:
        """A few images (H, W, 3) from the whole time range, with all their rows; at least one."""
        end = min(end, self.seconds)
        wanted = [start + (i + 0.5) / count * max(end - start, 0.0) for i in range(count)]
        with self._open() as (container, track):
            if len(self.times) > LOOKED_AT:
                images = (self._image_near(container, track, time) for time in wanted)
                if found := [image for image in images if image is not None]:
                    return found
        with self._open() as (container, track):
            positions = {min(bisect_left(self.times, time), LOOKED_AT - 1) for time in wanted if self.times} | {0}
            images = islice(decode(container, track, [], weave=True), max(positions) + 1)
            return [self._rgb(image, index) for index, image in enumerate(images) if index in positions]

    def _image_near(self, container: InputContainer, track: VideoStream, time: float) -> NDArray[np.uint8] | None:
        """The image at a time since the first one; None if the file cannot be searched."""
        at, image = time + self.start, None
        try:
            container.seek(int(at / (track.time_base or 1)), stream=track)
            for image in islice(decode(container, track, [], weave=True), LOOKED_AT):
                if image.seconds is None or image.seconds >= at - self._step / 2:
                    break
        except FFmpegError:
            pass
        return None if image is None else self._rgb(image, 0)

    def _rgb(self, image: DecodedImage, index: int) -> NDArray[np.uint8]:
        """(H, W, 3) upright image of square pixels; InputError if too large, or of another size than the first."""
        width, height = image.frame.width, image.frame.height
        shown = self._shown_width(width)
        demand_size(self.path, max(width, shown), height)
        if self._size == (0, 0):
            self._size = (width, height)
        if (width, height) != self._size:
            want, got = "{}x{} px as in the first image".format(*self._size), f"{width}x{height} in image {index}"
            raise input_error(self.path, want, got, "Cut the video there, or export it at one size.")
        rgb_u8 = image.frame.to_ndarray(format="rgb24")
        if shown != width:
            how = cv2.INTER_CUBIC if shown > width else cv2.INTER_AREA
            rgb_u8 = cv2.resize(rgb_u8, (shown, height), interpolation=how)
        return np.asarray(upright(rgb_u8, image.orientation), np.uint8)

    def _shown_width(self, width: int) -> int:
        """Width of an image of square pixels. It is even, so that the halves of a stereo image stay halves."""
        shown = width * self._aspect
        return width if self._aspect == 0 or abs(shown - width) < 1 else 2 * round(shown / 2)

    def _check_end(self, count: int, began: float, last: float, shown_until: float, broken: str) -> list[str]:
        """Reject a truncated file, and note a smaller difference from what the file announces.

        The number of images that a file announces proves nothing: trimmed MP4 files count images that are not shown,
        AVI files count repetitions. The time at which the last image ends is right in both.

        Args:
            count: number of images that were decoded.
            began, last, shown_until: start of the first image, start and end of the last one, s.
            broken: message of the decoder if it could not go on.
        """
        step, duration = self._step, self._announced_end - began
        missing, known = self._announced_end - shown_until, self._announced_end > 0
        if (broken and not known) or missing > max(LOST_SHARE * duration, LOST_IMAGES * step):
            want = f"{duration / step if known else self.num_frames:.0f} images"
            got = f"{count}, then {broken or 'the end: the file is truncated'}"
            fix = f"Copy it again, or use its first part with `--end {last - began:.2f}`."
            raise input_error(self.path, want, got, fix)
        ends_early = missing > 0.75 * step
        if not (ends_early or broken or self.num_frames not in (0, count)):
            return []
        end = f"; the last {missing:.2f} s are missing" if ends_early else ""
        announced = self.num_frames or round(duration / step)
        return [f"{self.path.name} announces {announced} images, {count} can be decoded{end}"]

    @contextmanager
    def _open(self) -> Iterator[tuple[InputContainer, VideoStream]]:
        try:
            container = open_container(self.path)
        except (FFmpegError, OSError, UnicodeError) as error:
            # FFmpeg calls a format that is not in the list an invalid argument.
            unlisted = isinstance(error, FFmpegError) and error.errno == errno.EINVAL
            reason = "a file of another kind" if unlisted else getattr(error, "strerror", None) or str(error)
            got = what_it_is(self.path) or reason
            fix = "Pass a folder with one file for each image." if got == "one image" else COPY_AGAIN
            raise input_error(self.path, "a video file", got, fix) from None
        with container:
            track = choose_track(container)
            if track is None:
                got = "images in an unknown format" if container.streams.video else "a file without images"
                raise input_error(self.path, "a video", got, "Check the path, or export it as H.264.")
            demand_size(self.path, track.codec_context.width, track.codec_context.height)
            # The size may change later, and that which the container states may be wrong.
            track.codec_context.options = {"max_pixels": str(MAX_PIXELS)}
            yield container, track


def transparent(count: int) -> str:
    """A note on images that have an alpha channel."""
    return f"{count} images have transparent parts; their color is used there, whatever it is"


def _is_transparent(frame: av.VideoFrame) -> bool:
    has_alpha = any(component.is_alpha for component in frame.format.components)
    return has_alpha and is_matte(frame.to_ndarray(format="rgba")[..., 3])


def _small(image: DecodedImage, width: int, height: int, is_gray: bool = False) -> NDArray[np.uint8]:
    if image.orientation in TURNED:
        width, height = height, width
    kind = "gray8" if is_gray else "rgb24"
    small = image.frame.reformat(width=width, height=height, format=kind, interpolation="AREA")
    return np.asarray(upright(small.to_ndarray(), image.orientation), np.uint8)


def demand_size(path: Path, width: int, height: int) -> None:
    """Raise InputError if the images of a video are too large."""
    if width * height > MAX_PIXELS:
        want = f"images of at most {MAX_PIXELS // 1_000_000} Mpx"
        raise input_error(path, want, f"{width}x{height}", "Export the video at a smaller size.")


def _announced_end(container: InputContainer, track: VideoStream) -> float:
    """Time at which the last image of a complete file ends, s; 0 if unknown."""
    if container.format.name == AVI and track.frames:  # FFmpeg shortens the duration of a truncated file
        return in_seconds(track, track.frames)
    if track.duration is not None:
        return in_seconds(track, (track.start_time or 0) + track.duration)
    # The duration of the file equals that of the images only if there is no other stream.
    if len(container.streams) == 1 and container.duration is not None:
        start = 0 if container.format.name in STATES_END else container.start_time or 0
        return (start + container.duration) / av.time_base
    return 0.0


def _unread_parts(path: Path, format_name: str, end: int) -> list[str]:
    """A note if files that are joined in this one begin after its last image, at byte `end`."""
    starts = starts_of_parts(path, format_name)
    used = max(sum(start <= end for start in starts), 1)
    if len(starts) <= used:
        return []
    first = "the first is" if used == 1 else f"the first {used} are"
    return [f"{path.name}: of {len(starts)} joined files only {first} used; join them with `ffmpeg -f concat`"]


def _of_high_range(path: Path, number: int) -> list[str]:
    """A note if the levels of a video, by the number of their transfer, do not mean what those of ordinary video do."""
    if number not in HIGH_RANGE:
        return []
    name, transfer = HIGH_RANGE[number]
    linear = f"zscale=tin={transfer}:min=bt2020nc:pin=bt2020:t=linear:npl=100,format=gbrpf32le,tonemap=hable"
    ordinary = f"{linear},zscale=t=bt709:m=bt709:p=bt709:r=tv,format=yuv420p"
    usual = path.with_name(f"{path.stem}_sdr.mp4")
    words = ["ffmpeg", "-i", path, "-vf", ordinary, "-crf", "10", usual]
    fix = f"`{' '.join(map(quoted, words))}`"
    what = f"{path.name}: HDR video ({name}) is read as ordinary video"
    return [ToDo(f"{what}: colors are wrong, mostly pale. Fix: {fix}")]


def _other_tracks(path: Path, container: InputContainer, used: VideoStream) -> list[str]:
    """A note if there are other tracks of images than the one that is used."""
    others = [track for track in container.streams.video if track.index != used.index and not is_cover(track)]
    if not others:
        return []

    def size(track: VideoStream) -> str:
        known = track.codec_context
        return f"{known.width}x{known.height} px" if known else "of an unknown format"

    shown = [f"{size(each)}{f', {each.frames} images' if each.frames else ''}" for each in (used, *others)]
    left_out = "; ".join(shown[1:])
    notes = [f"{path.name}: of {len(others) + 1} video tracks, only one is used ({shown[0]}), not: {left_out}"]
    if equal := [track for track in others if size(track) == size(used)]:
        second = path.with_name(f"{path.stem}_right{path.suffix}")
        words = ["ffmpeg", "-i", path, "-map", f"0:{equal[0].index}", "-c", "copy", second]
        split = " ".join(map(quoted, words))
        fix = f"`{split}`, then add `--right {quoted(second)}`"
        notes.append(ToDo(f"{path.name}: if the tracks are two cameras: {fix}"))
    return notes
