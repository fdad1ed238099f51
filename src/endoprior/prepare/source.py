"""Video files and image folders: a stream of images, each with its time.

Only a few images are in memory at a time. A source can be iterated any number of times.
"""

from __future__ import annotations

from collections import deque
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path

import av
import cv2
import numpy as np
from numpy.typing import NDArray

from ..core.checks import input_error
from ..data.files import files_with
from ..data.images import MOST_PIXELS, decode_image
from ..data.reading import kind_of
from ..data.series import one_per_frame
from ..data.video_files import STILL_SUFFIXES, open_container

LOST_SHARE, LOST_IMAGES = 0.02, 2
"""A video is truncated if more than this share of its duration and more than so many images are missing at its end."""
AVI = "avi"
"""FFmpeg's name of the format that counts time in images and does not hold when they are shown."""
STATES_END = ("matroska,webm", "nut")
"""FFmpeg's names of the formats whose duration is the time of the end, however late the first image is shown."""
RATES = (0.01, 100_000.0)
"""Plausible frame rates, 1/s; outside this range 25 is used."""


@dataclass(frozen=True)
class SourceFrame:
    """One image of a source."""

    index: int
    """Position in the source, from 0."""
    seconds: float
    """Time since the first image."""
    rgb_u8: NDArray[np.uint8]
    """(H, W, 3)."""


def open_source(path: Path, frames_per_second: float = 25.0) -> Source:
    """Open a video file or a folder of images.

    Args:
        frames_per_second: rate of a folder of images.
    Returns:
        The source. `num_frames` and `seconds` are the announced number of images and duration, 0 if unknown.
    Raises:
        InputError: the file does not exist or cannot be read.
    """
    if kind_of(path) == "a folder":
        return ImageFolder(path, frames_per_second)
    return Video(path)


class ImageFolder:
    """Images of one size, in the order of the numbers in their names."""

    def __init__(self, path: Path, frames_per_second: float) -> None:
        """List the folder; raises InputError if it has no images, or several of each frame."""
        self.path, self.frames_per_second = path, frames_per_second
        self.files, self.note = one_per_frame(path, files_with(path, STILL_SUFFIXES), "images")
        if not self.files:
            raise input_error(path, "images (PNG, JPEG, TIFF, BMP) or a video file", "none", "Check the path.")
        self.num_frames, self.seconds = len(self.files), len(self.files) / frames_per_second
        self.height, self.width = self._read(self.files[0]).shape[:2]

    def __iter__(self) -> Iterator[SourceFrame]:
        for index, file in enumerate(self.files):
            rgb_u8 = self._read(file)
            if rgb_u8.shape[:2] != (self.height, self.width):
                got = f"{rgb_u8.shape[1]}x{rgb_u8.shape[0]}"
                raise input_error(file, f"{self.width}x{self.height} px like the first image", got, "Make them equal.")
            yield SourceFrame(index, index / self.frames_per_second, rgb_u8)

    @staticmethod
    def _read(file: Path) -> NDArray[np.uint8]:
        return np.ascontiguousarray(decode_image(file, None, cv2.IMREAD_COLOR)[..., ::-1])


class Video:
    """A video file, decoded by FFmpeg through PyAV. Metadata (names, dates, places) is not read."""

    note: str
    """What a complete iteration has found to be odd about the file, one line; else empty."""

    def __init__(self, path: Path) -> None:
        """Open the file and decode the first image; raises InputError if that fails."""
        self.path, self.note = path, ""
        self._size: tuple[int, int] | None = None
        if (kind := kind_of(path)) != "a file":
            got = "no such file" if kind == "nothing" else kind
            raise input_error(path, "a video file or a folder of images", got, "Check the path.")
        if path.stat().st_size == 0:
            raise input_error(path, "a video file", "an empty file", "Copy it again.")
        with self._open() as container:
            stream = container.streams.video[0]
            # The average rate of some AVI files is that of their clock, such as 600.
            rates = [float(rate) for rate in (stream.average_rate, stream.guessed_rate) if rate]
            rate = min(rates, default=25.0)
            self.frames_per_second = rate if RATES[0] <= rate <= RATES[1] else 25.0
            self.num_frames = max(int(stream.frames), 0)
            self._announced_end = _announced_end(container)
            start = float((stream.start_time or 0) * stream.time_base)
            self.seconds = max(self._announced_end - start, 0.0) or self.num_frames / self.frames_per_second
        first = next(iter(self), None)
        if first is None:
            raise input_error(path, "a video with images", "none that can be decoded", "Copy or export it again.")
        self.height, self.width = first.rgb_u8.shape[:2]

    def __iter__(self) -> Iterator[SourceFrame]:
        step = 1 / self.frames_per_second
        began, index, seconds, shown_until, broken = None, 0, 0.0, 0.0, ""
        with self._open() as container:
            try:
                for frame, time in _decoded(container):
                    self._demand_size(frame.width, frame.height, index)
                    seconds = time if time is not None else index * step
                    shown_until = seconds + max(step, float((frame.duration or 0) * frame.time_base))
                    began = seconds if began is None else began
                    # Some cameras store the rotation of the images as metadata.
                    turns = round(getattr(frame, "rotation", 0) / 90) % 4
                    rgb_u8 = np.rot90(frame.to_ndarray(format="rgb24"), turns)
                    yield SourceFrame(index, seconds - began, np.ascontiguousarray(rgb_u8))
                    index += 1
            except av.error.FFmpegError as error:
                broken = error.strerror or str(error)
        self._check_end(index, began or 0.0, seconds, shown_until, broken)

    def _check_end(self, count: int, began: float, last: float, shown_until: float, broken: str) -> None:
        """Reject a truncated file, and note a smaller difference from what the file announces.

        The number of images that a file announces proves nothing: trimmed MP4 files count images that are not shown,
        AVI files count repetitions. The time at which the last image ends is right in both.

        Args:
            count: number of images that were decoded.
            began, last, shown_until: start of the first image, start and end of the last one, s.
            broken: message of the decoder if it could not go on.
        """
        step, duration = 1 / self.frames_per_second, self._announced_end - began
        missing = self._announced_end - shown_until
        known = self._announced_end > 0
        if (broken and not known) or missing > max(LOST_SHARE * duration, LOST_IMAGES * step):
            raise input_error(
                self.path,
                f"{duration / step if known else self.num_frames:.0f} images",
                f"{count}, then {broken or 'the end: the file is truncated'}",
                f"Copy it again, or use its first part with `--end {last - began:.2f}`.",
            )
        ends_early = missing > 0.75 * step
        if ends_early or broken or self.num_frames not in (0, count):
            end = f"; the last {missing:.2f} s are missing" if ends_early else ""
            announced = self.num_frames or round(duration / step)
            self.note = f"{self.path.name} announces {announced} images, {count} can be decoded{end}"

    def _demand_size(self, width: int, height: int, index: int) -> None:
        """Reject images that are too large, and a size that changes within the video."""
        if width * height > MOST_PIXELS:
            hint = "Export the video at a smaller size."
            raise input_error(self.path, f"images of at most {MOST_PIXELS // 1_000_000} Mpx", f"{width}x{height}", hint)
        self._size = self._size or (width, height)
        if (width, height) != self._size:
            want, got = "{}x{} px as in the first image".format(*self._size), f"{width}x{height} in image {index}"
            raise input_error(self.path, want, got, "Cut the video there, or export it at one size.")

    def _open(self) -> av.container.InputContainer:
        try:
            container = open_container(self.path)
        except (av.error.FFmpegError, OSError, UnicodeError) as error:
            # FFmpeg raises ArgumentError for a format that is not in the list.
            unlisted = isinstance(error, av.error.ArgumentError)
            got = "a playlist or another kind of file" if unlisted else getattr(error, "strerror", None) or str(error)
            raise input_error(self.path, "a video file", got, "Copy or export it again.") from None
        if not container.streams.video or (context := container.streams.video[0].codec_context) is None:
            got = "images in an unknown format" if container.streams.video else "a file without images"
            container.close()
            raise input_error(self.path, "a video", got, "Check the path, or export it as H.264.")
        context.options = {"max_pixels": str(MOST_PIXELS)}
        return container


def _announced_end(container: av.container.InputContainer) -> float:
    """Time at which the last image of a complete file ends, s; 0 if unknown."""
    stream = container.streams.video[0]
    if container.format.name == AVI and stream.frames:  # FFmpeg shortens the duration of a truncated file
        return float(stream.frames * stream.time_base)
    if stream.duration is not None:
        return float(((stream.start_time or 0) + stream.duration) * stream.time_base)
    # The duration of the file equals that of the images only if there is no other stream.
    if len(container.streams) == 1 and container.duration is not None:
        start = 0 if container.format.name in STATES_END else container.start_time or 0
        return (start + container.duration) / av.time_base
    return 0.0


def _decoded(container: av.container.InputContainer) -> Iterator[tuple[av.VideoFrame, float | None]]:
    """The images in the order in which they are shown, and their times, s; None if the file has no times.

    AVI holds the times at which images are decoded, not those at which they are shown. The decoder puts the images in
    order, and the n-th one gets the n-th time.
    """
    stream = container.streams.video[0]
    stream.thread_type = "AUTO"
    is_avi, decode_times = container.format.name == AVI, deque()
    for packet in container.demux(stream):
        if is_avi and packet.dts is not None:
            decode_times.append(packet.dts)
        for frame in packet.decode():
            ticks = frame.pts
            if is_avi:
                ticks = decode_times.popleft() if decode_times else None
            yield frame, None if ticks is None else float(ticks * stream.time_base)


Source = ImageFolder | Video
