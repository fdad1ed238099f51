"""A folder of images as a source: in natural order, of one size, 8 bits a channel or as many as are in use of 16."""

from __future__ import annotations

from collections.abc import Iterator
from functools import cached_property
from pathlib import Path

import cv2
import numpy as np
from numpy.typing import NDArray

from ..core.checks import input_error
from ..data.files import entries, files_with
from ..data.frame_files import one_per_frame
from ..data.images import decode_image, describe_pixels
from ..data.video_files import STILL_SUFFIXES
from .source_frame import SourceFrame

OTHER_IMAGES = (".webp", ".jp2", ".gif", ".avif", ".exr")
"""Suffixes of images that are counted, but not read."""


class ImageFolder:
    """Images of one size, in the order of the numbers in their names."""

    start = 0.0
    """Time of the first image on the clock of the files, s."""

    def __init__(self, path: Path, frames_per_second: float) -> None:
        """List the folder; raises InputError if it has no images, or several of each frame."""
        self.path, self.frames_per_second = path, frames_per_second
        self.files, self._left_out = one_per_frame(path, files_with(path, STILL_SUFFIXES), "images")
        if not self.files:
            raise input_error(path, "images (PNG, JPEG, TIFF, BMP) or a video file", "none", "Check the path.")
        self._others = [file for file in entries(path) if file.suffix.lower() in OTHER_IMAGES and file.name[0] != "."]
        self.times = [index / frames_per_second for index in range(len(self.files))]
        self.num_frames, self.seconds = len(self.files), len(self.files) / frames_per_second
        self.height, self.width = self._stored(self.files[0]).shape[:2]

    @property
    def notes(self) -> list[str]:
        """What is particular about the images, one line each."""
        found = [self._left_out] if self._left_out else []
        if self._others:
            kinds = ", ".join(sorted({file.suffix for file in self._others}))
            found.append(f"{self.path.name}: {len(self._others)} images of other kinds ({kinds}) are not used")
        stacks = [file for file in self.files if file.suffix.lower() in (".tif", ".tiff")]
        if pages := sum(max(cv2.imcount(str(file)) - 1, 0) for file in stacks):
            found.append(f"{self.path.name}: only the first image of each TIFF is used; {pages} more are not")
        if self._bits != 8:
            what = f"{self._bits} of 16 bits are in use, which become 0 to 255"
            found.append(f"{self.path.name}: images of 16 bits a channel: {what}")
        return found

    @property
    def was_damaged(self) -> bool:
        """Images are whole, or rejected."""
        return False

    def __iter__(self) -> Iterator[SourceFrame]:
        return map(self.image, range(len(self.files)))

    def image(self, index: int) -> SourceFrame:
        """One image; raises InputError if it cannot be used."""
        file = self.files[index]
        stored = self._stored(file)
        if stored.shape[:2] != (self.height, self.width):
            got = f"{stored.shape[1]}x{stored.shape[0]}"
            raise input_error(file, f"{self.width}x{self.height} px like the first image", got, "Make them equal.")
        rgb = (
            stored[..., ::-1] if stored.dtype == np.uint8 else (stored[..., ::-1] >> (self._bits - 8)).astype(np.uint8)
        )
        return SourceFrame(index, self.times[index], np.ascontiguousarray(rgb))

    def glimpses(self, start: float, end: float, count: int) -> list[NDArray[np.uint8]]:
        """A few images (H, W, 3) from the whole time range."""
        inside = [index for index, time in enumerate(self.times) if start <= time < end] or [0]
        return [self.image(index).rgb_u8 for index in inside[:: max(len(inside) // count, 1)]]

    @cached_property
    def _bits(self) -> int:
        """Bits a channel that are in use, at least 8. Medical cameras write 10 or 12 bits into files of 16."""
        if self._stored(self.files[0]).dtype == np.uint8:
            return 8
        largest = max(int(image.max()) for image in map(self._stored, self.files) if image.dtype == np.uint16)
        return max(largest.bit_length(), 8)

    @staticmethod
    def _stored(file: Path) -> NDArray:
        """(H, W, 3) blue, green, red of 8 or 16 bits."""
        pixels = decode_image(file, None, cv2.IMREAD_COLOR | cv2.IMREAD_ANYDEPTH)
        if pixels.dtype not in (np.uint8, np.uint16):
            raise input_error(file, "an image of 8 or 16 bits a channel", describe_pixels(pixels), "Save it as PNG.")
        return pixels
