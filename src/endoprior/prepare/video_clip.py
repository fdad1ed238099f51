"""A clip of one or two cameras: its video files, its stereo layout and the frames to use."""

from __future__ import annotations

import itertools
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from ..core.checks import input_error
from .calibration import Calibration
from .config import PrepareConfig
from .frame_geometry import MIN_SIDE_PX
from .frame_selection import FrameSelection
from .source import Source, SourceFrame, open_source
from .stereo_layout import Layout, camera_size, find_layout, split_cameras


@dataclass(frozen=True)
class StereoFrame:
    """The images of both cameras at one time, as stored in the source."""

    index: int
    """Position of the frame in the source, from 0."""
    left: NDArray[np.uint8]
    """(h, w, 3)."""
    right: NDArray[np.uint8] | None
    """(h, w, 3); None if the video is monocular."""


class Clip:
    """Video files and their layout. `stereo_frames` can be iterated any number of times."""

    def __init__(self, video: Path, cfg: PrepareConfig, calibration: Calibration | None) -> None:
        """Open the files and detect the layout; raises InputError if a file cannot be used."""
        rate = cfg.folder_rate
        self.source: Source = open_source(video, rate)
        self.second: Source | None = open_source(cfg.right, rate) if cfg.right else None
        self.swap = cfg.swap_eyes
        first = next(iter(self.source)).rgb_u8
        if min(first.shape[:2]) < MIN_SIDE_PX:
            got = f"{first.shape[1]}x{first.shape[0]}"
            raise input_error(video, f"images of at least {MIN_SIDE_PX}x{MIN_SIDE_PX} px", got, "Give the full size.")
        if cfg.layout == "auto":
            self.layout: Layout = find_layout(first, calibration, self.second is not None, str(video))
        else:
            self.layout = cfg.layout
        if self.layout == "two-files" and self.second is None:
            raise input_error("--layout two-files", "a second video", "none", "`--right VIDEO`.")
        if self.second is not None and (self.second.width, self.second.height) != first.shape[1::-1]:
            got = f"{self.second.width}x{self.second.height}"
            want = f"{first.shape[1]}x{first.shape[0]} px like {video}"
            raise input_error(str(cfg.right), want, got, "Pass the two videos of one recording.")
        self.stereo = self.layout != "mono"
        self.camera_size = camera_size(first.shape[1], first.shape[0], self.layout)
        self.frames_per_second = cfg.frames_per_second or self.source.frames_per_second
        self.only: frozenset[int] | None = None
        """Positions in the source of the frames to use, of those selected; None for all."""
        self._cfg = cfg

    def selection(self) -> FrameSelection:
        """The frames to use, with all counts at zero."""
        rate = self.source.frames_per_second
        return FrameSelection(self.frames_per_second, self._cfg.start, self._cfg.end, rate, self.only)

    def stereo_frames(self, selection: FrameSelection) -> Iterator[StereoFrame]:
        """The selected frames, in order.

        Raises:
            InputError: a file is damaged, or the second video ends before the first.
        """
        if self.second is None:
            for image in selection.pick(self.source):
                yield self._stereo_frame(image, *split_cameras(image.rgb_u8, self.layout))
            return
        pairs = itertools.zip_longest(self.source, self.second)
        others: dict[int, NDArray[np.uint8]] = {}

        def lefts() -> Iterator[SourceFrame]:
            for left, right in pairs:
                if left is None:
                    return
                if right is None:
                    hint = "Pass the two videos of one recording, or shorten the clip with --end."
                    raise input_error(self.second.path, f"frame {left.index} of the second camera", "the end", hint)
                others.clear()
                others[left.index] = right.rgb_u8
                yield left

        for image in selection.pick(lefts()):
            yield self._stereo_frame(image, image.rgb_u8, others[image.index])

    def _stereo_frame(
        self, image: SourceFrame, first: NDArray[np.uint8], second: NDArray[np.uint8] | None
    ) -> StereoFrame:
        if self.swap and second is not None:
            first, second = second, first
        return StereoFrame(image.index, first, second)


@dataclass
class SampledFrame:
    """A frame of the sample, and one a little later, which shows its motion."""

    frame: StereoFrame
    later: NDArray[np.uint8] | None
    """(h, w, 3) left image, None if the stream ends before."""
    later_at: int
    """Position of the later frame in the stream."""


class EvenSample:
    """Keeps a few frames, evenly spaced, of a stream of unknown length."""

    def __init__(self, most: int, ahead: int) -> None:
        """Args: most: number of frames to keep; at least half of it for a long stream. ahead: of the later frames."""
        self.kept: list[SampledFrame] = []
        self._most, self._ahead, self._step, self._seen = most, ahead, 1, 0

    def add(self, stereo_frame: StereoFrame) -> None:
        """Add the next frame of the stream."""
        for sampled in self.kept:
            if sampled.later_at == self._seen:
                sampled.later = stereo_frame.left
        if self._seen % self._step == 0:
            if len(self.kept) == self._most:
                self.kept, self._step = self.kept[::2], 2 * self._step
            if self._seen % self._step == 0:
                self.kept.append(SampledFrame(stereo_frame, None, self._seen + self._ahead))
        self._seen += 1
