"""The walk that writes frames: develop each shot, find depth and tools, compare with its neighbors, write."""

from __future__ import annotations

from collections import deque
from collections.abc import Callable, Iterable, Iterator
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from ..data.writer import FrameFiles
from .clip import Shot
from .stereo import temporal_median
from .view import View

REACH = 2
"""Frames to each side that depth is compared with."""
Mask = NDArray[np.bool_]
Depth = NDArray[np.float32]


@dataclass(frozen=True)
class Developed:
    """A shot as a frame, with what was measured on it."""

    position: int
    """Of the frame in the sequence, from 0."""
    index: int
    """Of the picture in the source."""
    rgb_u8: NDArray[np.uint8]
    """(H, W, 3)."""
    right_u8: NDArray[np.uint8] | None
    """(H, W, 3) of the second eye, rectified to the first one's rows."""
    depth: Depth | None
    """(H, W) mm, 0 where missing; None before it is known."""


@dataclass(frozen=True)
class Makers:
    """How depth and masks of a clip are made, each bound to what was learned from the samples."""

    measured: Callable[[Developed], Depth] | None
    """Depth that needs no mask: stereo, files, a network."""
    shaded: Callable[[NDArray[np.uint8], Mask], Depth] | None
    """Depth from shading, of a picture and where it may be used."""
    tools: Callable[[Developed], Mask]
    """(H, W) True on tools of a frame; what lies outside the picture does not count."""
    steady: bool
    """Whether depth is compared with the neighbors in time."""
    wanted: Callable[[NDArray[np.uint8]], bool]
    """Whether a picture (H, W, 3) belongs into the sequence."""


def develop(shots: Iterable[Shot], view: View, makers: Makers, first: int) -> Iterator[Developed]:
    """The wanted shots as frames, counted from 0; those before `first` are not measured and not returned."""
    position = 0
    for shot in shots:
        rgb_u8 = view.picture(shot.left)
        if not makers.wanted(rgb_u8):
            continue
        if position >= first:
            right = None if shot.right is None else view.picture(shot.right, right=True)
            frame = Developed(position, shot.index, rgb_u8, right, None)
            yield replace(frame, depth=makers.measured(frame)) if makers.measured else frame
        position += 1


def with_neighbors(frames: Iterable[Developed]) -> Iterator[list[Developed]]:
    """Each frame in the middle of those before and after it, `REACH` to each side or what the ends leave."""
    window: deque[Developed] = deque(maxlen=2 * REACH + 1)
    at = -1  # of the frame that is due, in the window

    def around() -> list[Developed]:
        reach = min(at, len(window) - 1 - at)
        return list(window)[at - reach : at + reach + 1]

    for frame in frames:
        at -= len(window) == window.maxlen
        window.append(frame)
        if len(window) > REACH:
            at += 1
            yield around()
    while at < len(window) - 1:
        at += 1
        yield around()


def write_frames(
    shots: Iterable[Shot],
    view: View,
    makers: Makers,
    files: FrameFiles,
    *,
    keep_right: bool,
    on_frame: Callable[[int], None] = lambda count: None,
) -> None:
    """Write every wanted shot that `files` does not have yet.

    Args:
        on_frame: called with the number of frames written after each.
    """
    done = files.count
    # Frames before the first one due are measured again, because their depth is compared with.
    for window in with_neighbors(develop(shots, view, makers, max(done - REACH, 0))):
        frame = window[len(window) // 2]
        if frame.position < done:
            continue
        depth = frame.depth
        if makers.steady:
            depth = temporal_median([other.depth for other in window])
        tools = makers.tools(frame) | ~view.inside
        if makers.shaded:
            depth = makers.shaded(frame.rgb_u8, ~tools)
        if depth is not None:
            depth = np.where(view.inside, depth, np.float32(0))
        rgb_u8 = np.where(view.inside[..., None], frame.rgb_u8, np.uint8(0))
        files.add(rgb_u8, tools, depth, frame.right_u8 if keep_right else None)
        on_frame(files.count)
