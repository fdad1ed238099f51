"""Second pass over a clip: rectify each frame, measure depth and tool mask, filter depth in time, write the files."""

from __future__ import annotations

from collections import deque
from collections.abc import Callable, Iterable, Iterator
from dataclasses import replace

import numpy as np

from ..data.found_tools import FoundTools
from ..data.writer import FrameFiles
from .first_pass import MeasuredFrame
from .frame_geometry import FrameGeometry
from .methods import FrameMethods
from .stereo import temporal_median
from .video_clip import StereoFrame

REACH = 2
"""Number of frames on each side in the temporal depth filter."""


def measure_frames(
    stereo_frames: Iterable[StereoFrame], geometry: FrameGeometry, methods: FrameMethods, first: int, used: list[int]
) -> Iterator[MeasuredFrame]:
    """Rectify the wanted frames and measure their depth, from position `first` on.

    Args:
        used: gets the position in the source of every wanted frame.
    """
    for stereo_frame in stereo_frames:
        frame = MeasuredFrame.of(stereo_frame, geometry, len(used))
        if not methods.wanted(frame.rgb_u8):
            continue
        used.append(stereo_frame.index)
        if frame.position >= first:
            yield replace(frame, depth=methods.measure(frame)) if methods.measure else frame


def with_neighbors(frames: Iterable[MeasuredFrame]) -> Iterator[list[MeasuredFrame]]:
    """For each frame, the window centered on it: `REACH` frames on each side, fewer at both ends."""
    window: deque[MeasuredFrame] = deque(maxlen=2 * REACH + 1)
    at = -1  # position of the center frame in the window

    def around() -> list[MeasuredFrame]:
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
    stereo_frames: Iterable[StereoFrame],
    geometry: FrameGeometry,
    methods: FrameMethods,
    files: FrameFiles,
    *,
    keep_right: bool,
    on_tools: Callable[[int, FoundTools], None],
    on_frame: Callable[[int], None],
) -> list[int]:
    """Write every wanted frame that `files` does not have yet.

    Args:
        on_tools: called with the position of each frame and its tools before its files are written.
        on_frame: called after each frame with the number of frames written.
    Returns:
        Position in the source of each frame of the sequence.
    """
    done, used = files.count, []
    # After a resume, measure a few finished frames again: the temporal filter needs their depth.
    for window in with_neighbors(measure_frames(stereo_frames, geometry, methods, max(done - REACH, 0), used)):
        frame = window[len(window) // 2]
        if frame.position < done:
            continue
        depth = frame.depth
        if methods.filter_in_time:
            depth = temporal_median([other.depth for other in window])
        found = methods.tools(frame)
        on_tools(frame.position, found)
        tools = found.mask | ~geometry.inside
        if methods.shade:
            depth = methods.shade(frame.rgb_u8, ~tools)
        if depth is not None:
            depth = np.where(geometry.inside, depth, np.float32(0))
        rgb_u8 = np.where(geometry.inside[..., None], frame.rgb_u8, np.uint8(0))
        files.add(rgb_u8, tools, depth, frame.right_u8 if keep_right else None)
        on_frame(files.count)
    return used
