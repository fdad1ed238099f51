"""A clip of one or two eyes: sources, layout and selection put together into shots."""

from __future__ import annotations

import itertools
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from ..data.reading import complaint
from .calibration import Calibration
from .config import PrepareConfig
from .layout import Layout, eye_size, find_layout, split_eyes
from .selection import Selection
from .source import Picture, Source, open_source
from .view import MIN_SIDE_PX


@dataclass(frozen=True)
class Shot:
    """What the eyes saw at one moment, as the source has it."""

    index: int
    """Of the picture in the source, from 0."""
    seconds: float
    """Since the first picture."""
    left: NDArray[np.uint8]
    """(h, w, 3)."""
    right: NDArray[np.uint8] | None
    """(h, w, 3), None for one eye."""


class Clip:
    """Sources and how to read them; iterate over `shots`, as often as needed."""

    def __init__(self, video: Path, cfg: PrepareConfig, calibration: Calibration | None) -> None:
        """Open the sources and decide the layout; raises InputError if that cannot be done."""
        rate = cfg.folder_rate
        self.source: Source = open_source(video, rate)
        self.second: Source | None = open_source(cfg.right, rate) if cfg.right else None
        self.swap = cfg.swap_eyes
        first = next(iter(self.source)).rgb_u8
        if min(first.shape[:2]) < MIN_SIDE_PX:
            got = f"{first.shape[1]}x{first.shape[0]}"
            raise complaint(video, f"pictures of at least {MIN_SIDE_PX}x{MIN_SIDE_PX} px", got, "Give the full size.")
        if cfg.layout == "auto":
            self.layout: Layout = find_layout(first, calibration, self.second is not None, str(video))
        else:
            self.layout = cfg.layout
        if self.layout == "two-files" and self.second is None:
            raise complaint("--layout two-files", "the second eye's video", "none", "Give it with --right.")
        if self.second is not None and (self.second.width, self.second.height) != first.shape[1::-1]:
            got = f"{self.second.width}x{self.second.height}"
            want = f"{first.shape[1]}x{first.shape[0]} px like {video}"
            raise complaint(str(cfg.right), want, got, "Give two eyes of one recording.")
        self.stereo = self.layout != "mono"
        self.eye_size = eye_size(first.shape[1], first.shape[0], self.layout)
        self.frames_per_second = cfg.frames_per_second or self.source.frames_per_second
        self._cfg = cfg

    def selection(self) -> Selection:
        """The grid of moments to take, counts at zero."""
        rate = self.source.frames_per_second
        return Selection(self.frames_per_second, self._cfg.start, self._cfg.end, rate)

    def shots(self, selection: Selection) -> Iterator[Shot]:
        """The selected shots in order.

        Raises:
            InputError: a source is damaged before the selection ends, or the second eye ends before the first.
        """
        if self.second is None:
            for picture in selection.pick(self.source):
                yield self._shot(picture, *split_eyes(picture.rgb_u8, self.layout))
            return
        pairs = itertools.zip_longest(self.source, self.second)
        others: dict[int, NDArray[np.uint8]] = {}

        def lefts() -> Iterator[Picture]:
            for left, right in pairs:
                if left is None:
                    return
                if right is None:
                    hint = "Give two eyes of one recording, or cut with --end."
                    raise complaint(str(self.second.path), f"picture {left.index} of the second eye", "the end", hint)
                others.clear()
                others[left.index] = right.rgb_u8
                yield left

        for picture in selection.pick(lefts()):
            yield self._shot(picture, picture.rgb_u8, others[picture.index])

    def _shot(self, picture: Picture, first: NDArray[np.uint8], second: NDArray[np.uint8] | None) -> Shot:
        if self.swap and second is not None:
            first, second = second, first
        return Shot(picture.index, picture.seconds, first, second)


class Spread:
    """Keeps a few shots of a stream whose length is not known, evenly spread over it."""

    def __init__(self, most: int) -> None:
        """Args: most: shots to keep; never fewer than half of them are kept of a long stream."""
        self.kept: list[Shot] = []
        self._most, self._step, self._seen = most, 1, 0

    def add(self, shot: Shot) -> None:
        """Look at the next shot of the stream."""
        if self._seen % self._step == 0:
            if len(self.kept) == self._most:
                self.kept, self._step = self.kept[::2], 2 * self._step
            if self._seen % self._step == 0:
                self.kept.append(shot)
        self._seen += 1
