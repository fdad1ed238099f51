"""Where pictures come from: a video file or a folder of images, one picture at a time, each with its moment.

Nothing here holds more than a few pictures; a source can be walked through as often as needed.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Protocol

import av
import cv2
import numpy as np
from numpy.typing import NDArray

from ..data.files import entries, natural_order
from ..data.images import MOST_PIXELS, decode_image
from ..data.reading import complaint, kind_of

IMAGE_SUFFIXES = (".png", ".jpg", ".jpeg", ".bmp", ".tif", ".tiff")
CUT_OFF = 0.98
"""A video that ends before this share of the frames it announces was cut off."""
CONTAINERS = "mov,mp4,matroska,webm,avi,mpegts,mpeg,mpegvideo,m4v,ogg,asf,flv,mxf,dv,h264,hevc,av1,obu,ivf,nut,gif"
"""FFmpeg's formats that hold pictures themselves; playlists, which name other files and addresses, are not."""
RATES = (0.01, 100_000.0)
"""Believable nominal rates, 1/s; outside, 25 is taken."""


@dataclass(frozen=True)
class Picture:
    """One picture of a source."""

    index: int
    """Counted over the source, from 0."""
    seconds: float
    """Since the first picture."""
    rgb_u8: NDArray[np.uint8]
    """(H, W, 3)."""


class Source(Protocol):
    """A clip that can be walked through again and again."""

    path: Path
    width: int
    height: int
    frames_per_second: float
    """Nominal rate."""
    num_frames: int
    """Announced number of pictures; 0 if the file does not say."""

    def __iter__(self) -> Iterator[Picture]: ...


def open_source(path: Path, frames_per_second: float | None = None) -> Source:
    """A video file or a folder of images.

    Args:
        frames_per_second: of a folder of images, which does not say; 25 if None.
    Raises:
        InputError: there is neither, or it cannot be read.
    """
    if kind_of(path) == "a folder":
        return ImageFolder(path, frames_per_second or 25.0)
    return Video(path)


class ImageFolder:
    """Pictures of one size, in the order of the numbers in their names."""

    def __init__(self, path: Path, frames_per_second: float) -> None:
        """List the folder; raises InputError if there are no pictures."""
        self.path, self.frames_per_second = path, frames_per_second
        found = (file for file in entries(path) if file.suffix.lower() in IMAGE_SUFFIXES and file.name[0] != ".")
        self.files = sorted(found, key=natural_order)
        if not self.files:
            raise complaint(path, "pictures (PNG, JPEG, TIFF, BMP) or a video file", "none", "Give the right folder.")
        self.num_frames = len(self.files)
        self.height, self.width = self._read(self.files[0]).shape[:2]

    def __iter__(self) -> Iterator[Picture]:
        for index, file in enumerate(self.files):
            rgb_u8 = self._read(file)
            if rgb_u8.shape[:2] != (self.height, self.width):
                got = f"{rgb_u8.shape[1]}x{rgb_u8.shape[0]}"
                raise complaint(file, f"{self.width}x{self.height} px like the first picture", got, "Make them equal.")
            yield Picture(index, index / self.frames_per_second, rgb_u8)

    @staticmethod
    def _read(file: Path) -> NDArray[np.uint8]:
        return np.ascontiguousarray(decode_image(file, None, cv2.IMREAD_COLOR)[..., ::-1])


class Video:
    """A video file, decoded by FFmpeg through PyAV. Metadata (names, dates, places) is not read."""

    def __init__(self, path: Path) -> None:
        """Open the file and decode one picture; raises InputError if that fails."""
        self.path = path
        self._size: tuple[int, int] | None = None
        if (kind := kind_of(path)) != "a file":
            got = "no such file" if kind == "nothing" else kind
            raise complaint(path, "a video file or a folder of pictures", got, "Check the path.")
        if path.stat().st_size == 0:
            raise complaint(path, "a video file", "an empty file", "Copy it again.")
        with self._open() as container:
            stream = container.streams.video[0]
            rate = float(stream.average_rate or stream.guessed_rate or 25)
            self.frames_per_second = rate if RATES[0] <= rate <= RATES[1] else 25.0
            self.num_frames = max(int(stream.frames), 0)
            # Of the whole file, so that it says something of the pictures only where there is nothing else.
            alone = len(container.streams) == 1 and container.duration is not None
            self._duration = container.duration / av.time_base if alone else 0.0
        first = next(iter(self), None)
        if first is None:
            raise complaint(path, "a video with pictures", "none that can be decoded", "Copy or export it again.")
        self.height, self.width = first.rgb_u8.shape[:2]

    def __iter__(self) -> Iterator[Picture]:
        began, index, seconds, broken = None, 0, 0.0, ""
        with self._open() as container:
            stream = container.streams.video[0]
            stream.thread_type = "AUTO"
            try:
                for frame in container.decode(stream):
                    self._demand_size(frame.width, frame.height, index)
                    seconds = frame.time if frame.time is not None else index / self.frames_per_second
                    began = seconds if began is None else began
                    # Cameras held upside down write a rotation beside the pictures.
                    turns = round(getattr(frame, "rotation", 0) / 90) % 4
                    rgb_u8 = np.rot90(frame.to_ndarray(format="rgb24"), turns)
                    yield Picture(index, seconds - began, np.ascontiguousarray(rgb_u8))
                    index += 1
            except av.error.FFmpegError as error:
                broken = error.strerror or str(error)
        shown = seconds - (began or 0.0) + 1.5 / self.frames_per_second
        if broken or index < CUT_OFF * self.num_frames or shown < CUT_OFF * self._duration:
            raise complaint(
                self.path,
                f"{self.num_frames or self._duration * self.frames_per_second:.0f} pictures",
                f"{index}, then {broken or 'the end: the file was cut off'}",
                f"Copy it again, or use what is there with --end {max(index - 1, 0) / self.frames_per_second:.2f}.",
            )

    def _demand_size(self, width: int, height: int, index: int) -> None:
        """Refuse pictures too large to be handled, and a size that changes on the way."""
        if width * height > MOST_PIXELS:
            hint = "Export it smaller."
            raise complaint(self.path, f"pictures of at most {MOST_PIXELS // 1_000_000} Mpx", f"{width}x{height}", hint)
        self._size = self._size or (width, height)
        if (width, height) != self._size:
            want, got = "{}x{} px as at the start".format(*self._size), f"{width}x{height} in picture {index}"
            raise complaint(self.path, want, got, "Cut the clip there, or export it at one size.")

    def _open(self) -> av.container.InputContainer:
        # The scheme keeps FFmpeg from taking a colon in the name for an address; the lists keep it in this one file.
        limits = {"format_whitelist": CONTAINERS, "protocol_whitelist": "file"}
        try:
            container = av.open(f"file:{self.path.absolute()}", options=limits)
        except (av.error.FFmpegError, OSError, UnicodeError) as error:
            # FFmpeg's word for a format that is not in the list.
            refused = isinstance(error, av.error.ArgumentError)
            got = "a playlist or another kind of file" if refused else getattr(error, "strerror", None) or str(error)
            raise complaint(self.path, "a video file", got, "Copy or export it again.") from None
        if not container.streams.video:
            container.close()
            raise complaint(self.path, "a video", "a file without pictures", "Give the video file.")
        context = container.streams.video[0].codec_context
        context.options = {"max_pixels": str(MOST_PIXELS)}
        return container
