"""Folders of images, animations and video files: a stream of images, each with its time.

Only a few images are in memory at a time. A source can be iterated any number of times.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator
from functools import cached_property, partial
from itertools import accumulate, islice
from pathlib import Path

import cv2
import numpy as np
from numpy.typing import NDArray
from PIL.Image import DecompressionBombError, Image
from PIL.Image import open as open_image

from ..core.checks import InputError, input_error
from ..core.shell import quoted
from ..data.files import entries, files_with, or_neighbor
from ..data.frame_files import missing_numbers, one_per_frame
from ..data.image_folders import contents_of, image_folders
from ..data.images import decode_image, describe_pixels
from ..data.load import what_is_in
from ..data.pixels import is_matte
from ..data.reading import kind_of
from ..data.video_files import STILL_SUFFIXES, is_animated_webp
from .decoding import USUAL_RATE, usual_rate
from .video import COPY_AGAIN, SmallImage, SourceFrame, Video, demand_size, transparent

OTHER_IMAGES = (".webp", ".jp2", ".gif", ".avif", ".exr")  # suffixes of images that are counted, but not read
WANTED = "images (PNG, JPEG, TIFF, BMP) or a video file"
ASSUMED_RATE = 25.0  # frame rate of a folder that does not tell its own, 1/s


class ImageFolder:
    """Images of one size, in the order of the numbers in their names: of 8 bits, or as many as are in use of 16."""

    start, was_damaged, clock_is_arbitrary = 0.0, False, False

    def __init__(self, path: Path, known_rate: float | None) -> None:
        """List the folder; raises InputError if it has no images, or several of each frame."""
        self.path, self.rate_is_assumed = path, known_rate is None
        self.frames_per_second = frames_per_second = ASSUMED_RATE if known_rate is None else known_rate
        self._transparent: set[int] = set()  # positions of images of which a part is transparent
        self.files, self._left_out = one_per_frame(path, files_with(path, STILL_SUFFIXES), "images")
        if not self.files:
            raise input_error(path, WANTED, "none", "pass the folder that holds them.")
        self.times = [index / frames_per_second for index in range(len(self.files))]
        self.num_frames, self.seconds = len(self.files), len(self.files) / frames_per_second
        first = self._stored(self.files[0])
        self.height, self.width = first.shape[:2]
        self._is_deep = first.dtype == np.uint16

    @property
    def notes(self) -> list[str]:
        """What is particular about the images, one line each."""
        found = []
        visible = [file for file in entries(self.path) if file.name[0] != "."]
        if others := [file for file in visible if file.suffix.lower() in OTHER_IMAGES]:
            kinds = ", ".join(sorted({file.suffix for file in others}))
            found.append(f"{len(others)} images of other kinds ({kinds}) are not used")
        stacks = [file for file in self.files if file.suffix.lower() in (".tif", ".tiff")]
        if pages := sum(max(cv2.imcount(str(file)) - 1, 0) for file in stacks):
            found.append(f"only the first image of each TIFF is used; {pages} more are not")
        if missing := missing_numbers(self.files):
            found.append(missing)
        if self._transparent:
            fix = f"To leave it out: `--masks {quoted(self.path)} --mask-tool-value low`"
            found.append(f"{transparent(len(self._transparent))}. {fix}")
        if self._bits != 8:
            found.append(f"images of 16 bits a channel: {self._bits} of 16 bits are in use, which become 0 to 255")
        left_out = [self._left_out] if self._left_out else []
        return left_out + [f"{self.path.name}: {words}" for words in found]

    def __iter__(self) -> Iterator[SourceFrame]:
        return map(self.image, range(len(self.files)))

    def image(self, index: int) -> SourceFrame:
        """One image; raises InputError if it cannot be used."""
        file = self.files[index]
        stored = self._stored(file)
        if stored.shape[:2] != (self.height, self.width):
            got = f"{stored.shape[1]}x{stored.shape[0]}"
            raise input_error(file, f"{self.width}x{self.height} px like the first image", got, "Make them equal.")
        if is_matte(stored[..., 3:]):
            self._transparent.add(index)
        if stored.dtype == np.uint16:
            if not self._is_deep:
                raise input_error(file, "8 bits a channel like the first image", "16", "Save it like the others.")
            stored = (stored >> (self._bits - 8)).astype(np.uint8)
        return SourceFrame(index, self.times[index], np.ascontiguousarray(stored[..., 2::-1]))

    def sample_images(self, start: float, end: float, count: int) -> list[NDArray[np.uint8]]:
        """A few images (H, W, 3) from the whole time range."""
        inside = [index for index, time in enumerate(self.times) if start <= time < end] or [0]
        return [self.image(index).rgb_u8 for index in inside[:: max(len(inside) // count, 1)]]

    @cached_property
    def _bits(self) -> int:
        """Bits a channel that are in use, at least 8. Medical cameras write 10 or 12 bits into files of 16."""
        if not self._is_deep:
            return 8
        largest = max(int(image[..., :3].max()) for image in map(self._stored, self.files) if image.dtype == np.uint16)
        return max(largest.bit_length(), 8)

    @staticmethod
    def _stored(file: Path) -> NDArray:
        """(H, W, 3 or 4) blue, green, red and maybe alpha of 8 or 16 bits."""
        pixels = decode_image(file, None)
        if pixels.dtype not in (np.uint8, np.uint16) or pixels.shape[2:] not in ((), (3,), (4,)):
            raise input_error(file, "an image of 8 or 16 bits a channel", describe_pixels(pixels), "Save it as PNG.")
        return np.repeat(pixels[..., None], 3, 2) if pixels.ndim == 2 else pixels


class Animation:
    """An animated WebP file, which FFmpeg does not read."""

    start, was_damaged, clock_is_arbitrary = 0.0, False, False

    def __init__(self, path: Path) -> None:
        """Read the durations; raises InputError if the file cannot be read."""
        self.path = path
        self.notes: list[str] = []  # of the images, after a complete iteration
        try:
            with open_image(path) as file:
                self.width, self.height = file.size
                demand_size(path, self.width, self.height)
                shown = [_shown(file, index) for index in range(getattr(file, "n_frames", 1))]
        except InputError:
            raise
        except (OSError, ValueError, SyntaxError, DecompressionBombError) as error:
            raise input_error(path, "a video", str(error).split("\n")[0], COPY_AGAIN) from None
        self.num_frames, self.times = len(shown), [0.0, *accumulate(shown[:-1])]
        self.seconds = self.times[-1] + shown[-1]
        self.frames_per_second = usual_rate(self.times, [])

    def __iter__(self) -> Iterator[SourceFrame]:
        count = 0
        with open_image(self.path) as file:
            for index, time in enumerate(self.times):
                file.seek(index)
                pixels = np.array(file.convert("RGBA"))
                count += is_matte(pixels[..., 3:])
                yield SourceFrame(index, time, np.ascontiguousarray(pixels[..., :3]))
        self.notes = [f"{self.path.name}: {transparent(count)}"] if count else []

    def sample_images(self, _start: float, _end: float, count: int) -> list[NDArray[np.uint8]]:
        """A few images (H, W, 3) from the whole file."""
        return [image.rgb_u8 for image in islice(self, 0, None, max(self.num_frames // count, 1))]


def _shown(file: Image, index: int) -> float:
    """How long an image is shown, s; a duration of 0 says nothing. Pillow knows it when the image is decoded."""
    file.seek(index)
    file.load()
    return float(file.info.get("duration", 0)) / 1000 or 1 / USUAL_RATE


Source = ImageFolder | Video | Animation


def quick_images(source: Source) -> Iterator[tuple[float, SmallImage]]:
    """As `Video.quick_images`, for every kind of source."""
    if isinstance(source, Video):
        yield from source.quick_images()
    elif isinstance(source, ImageFolder):
        for index, time in enumerate(source.times):
            yield time, partial(_resized, lambda index=index: source.image(index).rgb_u8)
    else:
        for image in source:
            yield image.seconds, partial(_resized, lambda image=image: image.rgb_u8)


def _resized(
    read: Callable[[], NDArray[np.uint8]], width: int, height: int, is_gray: bool = False
) -> NDArray[np.uint8]:
    small = np.asarray(cv2.resize(read(), (width, height), interpolation=cv2.INTER_AREA), np.uint8)
    return np.asarray(cv2.cvtColor(small, cv2.COLOR_RGB2GRAY), np.uint8) if is_gray else small


def open_source(path: Path, folder_rate: float | None = None) -> Source:
    """Open a video file or a folder of images, which may lie in a folder of their own beside their masks.

    Args:
        folder_rate: frame rate of a folder, 1/s; None: that of its `sequence.json`, else `ASSUMED_RATE`.

    Returns:
        The source. `num_frames` and `seconds` are the announced number of images and duration, 0 if unknown; `times`
        holds when each image is shown, s since the first; `notes` what is particular about it, after an iteration.
    Raises:
        InputError: the file does not exist or cannot be read.
    """
    if (kind := kind_of(path)) == "a folder":
        return _open_folder(path, folder_rate)
    if kind != "a file":
        got = "no such file or folder" if kind == "nothing" else kind
        fix = or_neighbor("correct the path.", path) if kind == "nothing" else "correct the path."
        raise input_error(path, "a video file or a folder of images", got, fix)
    return Animation(path) if is_animated_webp(path) else Video(path)


def _open_folder(path: Path, rate: float | None) -> ImageFolder:
    if found := contents_of(path):
        return ImageFolder(found.images, rate or found.frames_per_second)
    if files_with(path, STILL_SUFFIXES):
        return ImageFolder(path, rate)
    known = what_is_in(path)
    if known is None and (several := image_folders(path)):
        known = f"images in {', '.join(each.name for each in several)}", f"pass one, such as {quoted(several[0])}."
    raise input_error(path, WANTED, *(known or ("none", "pass the folder that holds images, or a video.")))
