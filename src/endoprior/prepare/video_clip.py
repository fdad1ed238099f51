"""A clip of one or two cameras: its video files, its stereo layout and the frames to use."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from ..core.checks import input_error
from .calibration import Calibration
from .config import PrepareConfig
from .frame_geometry import MIN_SIDE_PX
from .frame_selection import FrameSelection
from .pairing import Pairing, find_pairing
from .source import Source, SourceFrame, open_source
from .stereo_layout import Layout, camera_size, find_layout, split_cameras
from .video import Video

GLIMPSES = 9
"""Number of images that tell the stereo layout."""


@dataclass(frozen=True)
class StereoFrame:
    """The images of both cameras at one time, as stored in the source."""

    index: int
    """Position of the frame in the source, from 0."""
    left: NDArray[np.uint8]
    """(h, w, 3)."""
    right: NDArray[np.uint8] | None
    """(h, w, 3); None if the video is monocular."""
    damaged: bool = False
    """Bytes of one of them, or of what it was predicted from, are missing or wrong."""


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
            got = f"{self.second.width}x{self.second.height}"
            want = f"{width}x{height} px like {video}"
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
        others: dict[int, SourceFrame] = {}
        self.unpaired = 0

        def paired() -> Iterator[SourceFrame]:
            for image, other in self._pairing.pairs(self.source, self.second):
                if other is None:
                    self.unpaired += self._cfg.start <= image.seconds < self._cfg.end
                    continue
                others.clear()
                others[image.index] = other
                yield image

        for image in selection.pick(paired()):
            other = others[image.index]
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
    wider = np.diag([aspect, 1.0, 1.0])
    cameras = [
        camera and replace(camera, matrix=wider @ camera.matrix) for camera in (calibration.left, calibration.right)
    ]
    size = calibration.size and (round(calibration.size[0] * aspect), calibration.size[1])
    return replace(calibration, left=cameras[0], right=cameras[1], size=size), True


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
