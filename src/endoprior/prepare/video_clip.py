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
from .frame_selection import FrameSelection, Pairing, find_pairing
from .source import Source, open_source
from .video import SourceFrame, Video

KINDS: tuple[Layout, ...] = ("side-by-side", "top-bottom", "interlaced")  # how one frame can hold two images
LOOK_ALIKE = 0.8  # correlation above which the halves of a frame are two views of the same scene
GLIMPSES = 9  # number of images that tell the stereo layout
CONTENT = 3.0
"""Least standard deviation, levels of 255, of a frame that shows something, in each of its rows and columns."""


def split_cameras(frame: NDArray[np.uint8], layout: Layout) -> tuple[NDArray[np.uint8], NDArray[np.uint8] | None]:
    """Images of the first and second camera; the second is None for `mono` and `two-files`.

    Args:
        frame: (H, W, 3).
        layout: not `auto`. An interlaced frame holds the cameras in its even and odd rows. Both images come back with H
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


def _fill_rows(frame: NDArray[np.uint8], parity: int) -> NDArray[np.uint8]:
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
    if layout == "side-by-side":
        return width // 2, height
    return (width, height // 2) if layout == "top-bottom" else (width, height)


def find_layout(
    frames: Sequence[NDArray[np.uint8]], calibration: Calibration | None, has_second_source: bool, name: str
) -> Layout:
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
    height, width = frames[0].shape[:2]
    telling = [frame for frame in frames if _shows_something(frame)]
    stereo = calibration is not None and calibration.right is not None
    alike = [kind for kind in KINDS if sum(_alike(frame, kind) for frame in telling) > len(telling) / 2]
    if not stereo:
        if alike and alike[0] != "interlaced":
            hint = f"`--calibration FILE --layout {alike[0]}`, or `--layout mono` if there is one camera."
            raise input_error(name, "a calibration for a stereo video", f"none, and a {alike[0]} frame", hint)
        return "mono"
    stated = calibration.layout or ""
    for kind in KINDS:
        if kind in stated.lower():
            return kind
    if calibration.size:
        across, down = width / calibration.size[0], height / calibration.size[1]
        if abs(across / down - 2) < 0.02:
            return "side-by-side"
        if abs(across / down - 0.5) < 0.005:
            return "top-bottom"
        if abs(across / down - 1) < 0.01 and "interlaced" in alike:
            return "interlaced"
    if alike:
        return alike[0]
    hint = "`--layout side-by-side`, `top-bottom` or `interlaced`, or `--right VIDEO` for a second video."
    raise input_error(name, "two cameras in each frame", f"{width}x{height} px without a known layout", hint)


def _shows_something(frame: NDArray[np.uint8]) -> bool:
    """Whether a frame varies within its rows and within its columns, unlike a black one or color bars."""
    gray = cv2.cvtColor(frame, cv2.COLOR_RGB2GRAY)
    small = cv2.resize(gray, (96, 64), interpolation=cv2.INTER_AREA).astype(np.float32)
    return bool(min(np.median(small.std(0)), np.median(small.std(1))) > CONTENT)


def _alike(frame: NDArray[np.uint8], layout: Layout) -> bool:
    """Whether both halves show nearly the same image, up to a shift along x."""
    gray = cv2.cvtColor(frame, cv2.COLOR_RGB2GRAY)
    if layout == "interlaced":
        rows = gray[: len(gray) // 2 * 2].astype(np.float32)
        # Rows of one camera are more similar to each other than to the rows of the other camera.
        own, other = np.abs(rows[2:] - rows[:-2]).mean(), np.abs(rows[1:] - rows[:-1]).mean()
        return bool(other > 1.2 * own)
    first, second = (
        cv2.resize(np.ascontiguousarray(half), (96, 64), interpolation=cv2.INTER_AREA).astype(np.float32)
        for half in split_cameras(gray[..., None], layout)
    )
    return bool(cv2.matchTemplate(second, first[:, 16:-16], cv2.TM_CCOEFF_NORMED).max() > LOOK_ALIKE)


@dataclass(frozen=True)
class StereoFrame:
    """The images of both cameras at one time, as stored in the source."""

    index: int  # position of the frame in the source, from 0
    left: NDArray[np.uint8]  # (h, w, 3)
    right: NDArray[np.uint8] | None  # (h, w, 3); None if the video is monocular
    damaged: bool = False  # bytes of one of them, or of what it was predicted from, are missing or wrong


class Clip:
    """Video files and their layout. `stereo_frames` can be iterated any number of times."""

    def __init__(self, video: Path, cfg: PrepareConfig, calibration: Calibration | None) -> None:
        """Open the files and detect the layout; raises InputError if a file cannot be used."""
        rate = cfg.folder_rate
        self.source: Source = open_source(video, rate)
        self.second: Source | None = open_source(cfg.right, rate) if cfg.right else None
        self.swap = cfg.swap_eyes
        width, height = self.source.width, self.source.height
        if min(width, height) < MIN_SIDE_PX:
            got = f"{width}x{height}"
            raise input_error(video, f"images of at least {MIN_SIDE_PX}x{MIN_SIDE_PX} px", got, "Give the full size.")
        self.calibration, self._rescaled = _of_square_pixels(calibration, self.source)
        if cfg.layout == "auto":
            images = self.source.glimpses(cfg.start, cfg.end, GLIMPSES)
            self.layout: Layout = find_layout(images, self.calibration, self.second is not None, str(video))
        else:
            self.layout = cfg.layout
        if self.layout == "two-files" and self.second is None:
            raise input_error("--layout two-files", "a second video", "none", "`--right VIDEO`.")
        if self.second is not None and (self.second.width, self.second.height) != (width, height):
            got, want = f"{self.second.width}x{self.second.height}", f"{width}x{height} px like {video}"
            raise input_error(str(cfg.right), want, got, "Pass the two videos of one recording.")
        if self.layout == "interlaced" and isinstance(self.source, Video):
            self.source.weave = True
        self.stereo = self.layout != "mono"
        self.camera_size = camera_size(width, height, self.layout)
        self._pairing: Pairing | None = find_pairing(self.source, self.second) if self.second else None
        self._rate = self._pairing.rate if self._pairing else self.source.frames_per_second
        self.frames_per_second = cfg.frames_per_second or self._rate
        self.unpaired = 0
        """Images of the first video, in the last iteration, without one of the second video at their time."""
        self.only: frozenset[int] | None = None
        """Positions in the source of the frames to use, of those selected; None for all."""
        self._cfg = cfg

    @property
    def was_damaged(self) -> bool:
        """Whether an iteration has met damaged images."""
        return self.source.was_damaged or (self.second is not None and self.second.was_damaged)

    @property
    def notes(self) -> list[str]:
        """What is particular about the video files, one line each, after a complete iteration."""
        notes = [note for source in (self.source, self.second) if source for note in source.notes]
        if self._rescaled:
            notes.append("the calibration belongs to the stored pixels, which are not square; it is scaled with them")
        if self._pairing and self._pairing.note:
            notes.append(self._pairing.note)
        if self.unpaired:
            name = self.source.path.name
            notes.append(f"{name}: {self.unpaired} images have none of the second camera and are left out")
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
        if self.second is None or self._pairing is None:
            for image in selection.pick(self.source):
                yield self._stereo_frame(image, *split_cameras(image.rgb_u8, self.layout))
            return
        self.unpaired, other = 0, None

        def paired() -> Iterator[SourceFrame]:
            nonlocal other
            for image, other in self._pairing.pairs(self.source, self.second):
                if other is None:
                    self.unpaired += self._cfg.start <= image.seconds < self._cfg.end
                else:
                    yield image

        for image in selection.pick(paired()):
            yield self._stereo_frame(image, image.rgb_u8, other.rgb_u8, damaged=other.damaged)
        if not selection.taken:
            hint = "Pass the two videos of one recording."
            raise input_error(self.second.path, f"images at the times of {self.source.path}", "none", hint)

    def _stereo_frame(
        self, image: SourceFrame, first: NDArray[np.uint8], second: NDArray[np.uint8] | None, *, damaged: bool = False
    ) -> StereoFrame:
        if self.swap and second is not None:
            first, second = second, first
        return StereoFrame(image.index, first, second, damaged or image.damaged)


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


class EvenSample:
    """Keeps a few frames, evenly spaced, of a stream of unknown length."""

    def __init__(self, most: int) -> None:
        """Args: most: number of frames to keep; at least half of it for a long stream."""
        self.kept: list[StereoFrame] = []
        self._most, self._step, self._seen = most, 1, 0

    def add(self, stereo_frame: StereoFrame) -> None:
        """Add the next frame of the stream."""
        if self._seen % self._step == 0:
            if len(self.kept) == self._most:
                self.kept, self._step = self.kept[::2], 2 * self._step
            if self._seen % self._step == 0:
                self.kept.append(stereo_frame)
        self._seen += 1
