"""Video files and image folders: a stream of images, each with its time.

Only a few images are in memory at a time. A source can be iterated any number of times.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path

import av
import cv2
import numpy as np
from numpy.typing import NDArray

from ..core.checks import input_error
from ..data.files import entries, natural_order
from ..data.images import MOST_PIXELS, decode_image
from ..data.reading import kind_of
from ..data.video_files import STILL_SUFFIXES, open_container

CUT_OFF = 0.98
"""A video is truncated if it ends before this share of its announced frames."""
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
        The source. `num_frames` is the announced number of images, 0 if unknown.
    Raises:
        InputError: the file does not exist or cannot be read.
    """
    if kind_of(path) == "a folder":
        return ImageFolder(path, frames_per_second)
    return Video(path)


class ImageFolder:
    """Images of one size, in the order of the numbers in their names."""

    def __init__(self, path: Path, frames_per_second: float) -> None:
        """List the folder; raises InputError if it has no images."""
        self.path, self.frames_per_second = path, frames_per_second
        found = (file for file in entries(path) if file.suffix.lower() in STILL_SUFFIXES and file.name[0] != ".")
        self.files = sorted(found, key=natural_order)
        if not self.files:
            raise input_error(path, "images (PNG, JPEG, TIFF, BMP) or a video file", "none", "Check the path.")
        self.num_frames = len(self.files)
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

    def __init__(self, path: Path) -> None:
        """Open the file and decode the first image; raises InputError if that fails."""
        self.path = path
        self._size: tuple[int, int] | None = None
        if (kind := kind_of(path)) != "a file":
            got = "no such file" if kind == "nothing" else kind
            raise input_error(path, "a video file or a folder of images", got, "Check the path.")
        if path.stat().st_size == 0:
            raise input_error(path, "a video file", "an empty file", "Copy it again.")
        with self._open() as container:
            stream = container.streams.video[0]
            rate = float(stream.average_rate or stream.guessed_rate or 25)
            self.frames_per_second = rate if RATES[0] <= rate <= RATES[1] else 25.0
            self.num_frames = max(int(stream.frames), 0)
            # The duration of the file equals that of the images only if there is no other stream.
            alone = len(container.streams) == 1 and container.duration is not None
            self._duration = container.duration / av.time_base if alone else 0.0
        first = next(iter(self), None)
        if first is None:
            raise input_error(path, "a video with images", "none that can be decoded", "Copy or export it again.")
        self.height, self.width = first.rgb_u8.shape[:2]

    def __iter__(self) -> Iterator[SourceFrame]:
        began, index, seconds, broken = None, 0, 0.0, ""
        with self._open() as container:
            stream = container.streams.video[0]
            stream.thread_type = "AUTO"
            try:
                for frame in container.decode(stream):
                    self._demand_size(frame.width, frame.height, index)
                    seconds = frame.time if frame.time is not None else index / self.frames_per_second
                    began = seconds if began is None else began
                    # Some cameras store the rotation of the images as metadata.
                    turns = round(getattr(frame, "rotation", 0) / 90) % 4
                    rgb_u8 = np.rot90(frame.to_ndarray(format="rgb24"), turns)
                    yield SourceFrame(index, seconds - began, np.ascontiguousarray(rgb_u8))
                    index += 1
            except av.error.FFmpegError as error:
                broken = error.strerror or str(error)
        decoded = seconds - (began or 0.0) + 1.5 / self.frames_per_second
        if broken or index < CUT_OFF * self.num_frames or decoded < CUT_OFF * self._duration:
            raise input_error(
                self.path,
                f"{self.num_frames or self._duration * self.frames_per_second:.0f} images",
                f"{index}, then {broken or 'the end: the file is truncated'}",
                f"Copy it again, or use its first part with `--end {max(index - 1, 0) / self.frames_per_second:.2f}`.",
            )

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
        if not container.streams.video:
            container.close()
            raise input_error(self.path, "a video", "a file without images", "Check the path.")
        context = container.streams.video[0].codec_context
        context.options = {"max_pixels": str(MOST_PIXELS)}
        return container


Source = ImageFolder | Video
