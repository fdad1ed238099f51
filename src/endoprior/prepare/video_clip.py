"""A clip of one or two cameras: its video files, how the images of both cameras are stored, and the frames to use."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path

import cv2
import numpy as np
from numpy.typing import NDArray

from ..core.checks import input_error
from .calibration import Calibration
from .config import Layout, PrepareConfig
from .frame_geometry import MIN_SIDE_PX
from .frame_selection import FrameSelection, Pairing
from .source import Source, open_source
from .video import SourceFrame, Video

KINDS: tuple[Layout, ...] = ("side-by-side", "top-bottom", "interlaced")  # how one frame can hold two images
LOOK_ALIKE = 0.8  # correlation above which the halves of a frame are two views of the same scene
GLIMPSES = 9  # number of images that tell the stereo layout
CONTENT = 3.0  # least standard deviation, levels, of a frame that shows something, in each of its rows and columns
Image = NDArray[np.uint8]


def split_cameras(frame: Image, layout: Layout) -> tuple[Image, Image | None]:
    """Images of the first and second camera; the second is None for `mono` and `two-files`.

    Args:
        frame: (H, W, 3). An interlaced one holds the cameras in its even and odd rows. Both images come back with H
            rows, missing rows interpolated, so that rows keep their true heights.
    """
    height, width = frame.shape[:2]
    if layout == "side-by-side":
        return frame[:, : width // 2], frame[:, width // 2 : width // 2 * 2]
    if layout == "top-bottom":
        return frame[: height // 2], frame[height // 2 : height // 2 * 2]
    if layout == "interlaced":
        return _fill_rows(frame, 0), _fill_rows(frame, 1)
    return frame, None


def _fill_rows(frame: Image, parity: int) -> Image:
    """(H, W, 3) with the rows of the other parity replaced by the mean of their neighbors."""
    filled, own = frame.copy(), frame[parity::2].astype(np.uint16)
    filled[parity + 1 : parity + 2 * len(own) - 1 : 2] = (own[:-1] + own[1:] + 1) // 2
    if parity:
        filled[0] = frame[1]
    if (len(frame) - 1) % 2 != parity:
        filled[-1] = filled[-2]
    return filled


def camera_size(width: int, height: int, layout: Layout) -> tuple[int, int]:
    """(width, height) of one camera's image, px."""
    return width // (1 + (layout == "side-by-side")), height // (1 + (layout == "top-bottom"))


def find_layout(frames: Sequence[Image], calibration: Calibration | None, has_second_source: bool, name: str) -> Layout:
    """Detect the layout from the image size of the calibration and from the content of a few frames.

    Args:
        frames: (H, W, 3) each, from all parts of the source. Black, uniform and striped ones say nothing; of the
            others, more than half must have the layout.
        name: of the source, for the error message.
    Raises:
        InputError: the layout cannot be detected.
    """
    if has_second_source:
        return "two-files"
    telling = [frame for frame in frames if _shows_something(frame)]
    alike: list[Layout] = [kind for kind in KINDS if sum(_alike(frame, kind) for frame in telling) > len(telling) / 2]
    if calibration is None or calibration.right is None:
        if alike and alike[0] != "interlaced":
            fix = f"`--calibration FILE --layout {alike[0]}`, or `--layout mono` if there is one camera."
            raise input_error(name, "a calibration for a stereo video", f"none, and a {alike[0]} frame", fix)
        return "mono"
    height, width = frames[0].shape[:2]
    stated: list[Layout] = [kind for kind in KINDS if kind in (calibration.layout or "").lower()]
    found: list[Layout] = [*stated, *_by_size(width, height, calibration, alike), *alike]
    if found:
        return found[0]
    fix = "`--layout side-by-side`, `top-bottom` or `interlaced`, or `--right VIDEO` for a second video."
    raise input_error(name, "two cameras in each frame", f"{width}x{height} px without a known layout", fix)


def _by_size(width: int, height: int, calibration: Calibration, alike: list[Layout]) -> list[Layout]:
    """The layout whose frame holds two images of the calibrated shape."""
    if not calibration.size:
        return []
    aspect = width / calibration.size[0] / (height / calibration.size[1])
    fits = abs(aspect - 2) < 0.02, abs(aspect - 0.5) < 0.005, abs(aspect - 1) < 0.01 and "interlaced" in alike
    return [kind for kind, fit in zip(KINDS, fits, strict=True) if fit]


def _shows_something(frame: Image) -> bool:
    """Whether a frame varies within its rows and within its columns, unlike a black one or color bars."""
    small = _small(cv2.cvtColor(frame, cv2.COLOR_RGB2GRAY))
    return bool(min(np.median(small.std(0)), np.median(small.std(1))) > CONTENT)


def _alike(frame: Image, layout: Layout) -> bool:
    """Whether both halves show nearly the same image, up to a shift along x."""
    gray = np.asarray(cv2.cvtColor(frame, cv2.COLOR_RGB2GRAY), np.uint8)
    if layout == "interlaced":
        rows = gray[: len(gray) // 2 * 2].astype(np.float32)
        # Rows of one camera are more similar to each other than to the rows of the other camera.
        own, other = np.abs(rows[2:] - rows[:-2]).mean(), np.abs(rows[1:] - rows[:-1]).mean()
        return bool(other > 1.2 * own)
    first, second = (_small(half) for half in split_cameras(gray[..., None], layout) if half is not None)
    return bool(cv2.matchTemplate(second, first[:, 16:-16], cv2.TM_CCOEFF_NORMED).max() > LOOK_ALIKE)


def _small(gray: NDArray) -> NDArray:
    return cv2.resize(np.ascontiguousarray(gray), (96, 64), interpolation=cv2.INTER_AREA).astype(np.float32)


@dataclass(frozen=True)
class StereoFrame:
    """The images of both cameras at one time, as stored in the source."""

    index: int  # position of the frame in the source, from 0
    seconds: float  # since the first image
    left: Image  # (h, w, 3)
    right: Image | None  # (h, w, 3); None if the video is monocular
    damaged: bool = False  # bytes of one of them, or of what it was predicted from, are missing or wrong


class Clip:
    """Video files and their layout. `stereo_frames` can be iterated any number of times."""

    def __init__(self, video: Path, cfg: PrepareConfig, calibration: Calibration | None) -> None:
        """Open the files and detect the layout; raises InputError if a file cannot be used."""
        self._cfg, self.swap = cfg, cfg.swap_eyes
        self.source: Source = open_source(video, cfg.folder_rate)
        second = open_source(cfg.right, cfg.folder_rate) if cfg.right else None
        self._sources = [self.source, *([second] if second else [])]
        width, height = self.source.width, self.source.height
        if min(width, height) < MIN_SIDE_PX:
            got = f"{width}x{height}"
            raise input_error(video, f"images of at least {MIN_SIDE_PX}x{MIN_SIDE_PX} px", got, "Give the full size.")
        self.calibration, self._rescaled = _of_square_pixels(calibration, self.source)
        self.layout: Layout = cfg.layout
        if cfg.layout == "auto":
            images = self.source.glimpses(cfg.start, cfg.end, GLIMPSES)
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
        if self._pairing is None:
            for image in self.source:
                yield self._stereo_frame(image, *split_cameras(image.rgb_u8, self.layout))
            return
        self._unpaired = 0
        for image, other in self._pairing:
            if other is None:
                self._unpaired += self._cfg.start <= image.seconds < self._cfg.end
            else:
                yield self._stereo_frame(image, image.rgb_u8, other.rgb_u8, other.damaged)

    def _stereo_frame(
        self, image: SourceFrame, first: Image, second: Image | None, damaged: bool = False
    ) -> StereoFrame:
        if self.swap and second is not None:
            first, second = second, first
        return StereoFrame(image.index, image.seconds, first, second, damaged or image.damaged)


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
