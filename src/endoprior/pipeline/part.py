"""Choose the part of a video that one scene can show. Pure functions."""

from __future__ import annotations

import math
import sys
from dataclasses import dataclass
from itertools import islice

from ..prepare.frame_selection import FrameSelection

LEAST_RATE = 10.0
"""Frame rate, 1/s, below which tissue and camera move too far between two frames to be followed."""
LOST_FRAMES = 5
"""So many frames in a row without a pose: the camera is lost. Fewer are blurred or covered."""
FEWEST_FRAMES = 20
"""Fewer frames are not worth a scene."""


@dataclass(frozen=True)
class Part:
    """Part of a video."""

    frames_per_second: float
    """Rate of the frames that are used."""
    start: float
    """First time, seconds."""
    end: float
    """End time, seconds, not included; infinite for the end of the video."""
    num_frames: int
    """Number of frames."""
    is_whole: bool
    """Whether it reaches the end that was asked for."""


def choose_part(
    seconds: float, rate: float, wanted_rate: float, start: float, end: float, most: int, usual: int | None = None
) -> Part:
    """The first part of a video that has at most `most` frames.

    A long video loses frames in between, down to `LEAST_RATE`, until it has at most `usual`, then its end.

    Args:
        usual: None: `most`.
        seconds: duration of the video; 0 if unknown.
        rate: of the video, 1/s.
        wanted_rate: rate that the user chose, 1/s; 0 for none.
        start, end: times that the user chose; the end may be infinite.
    """
    images = round(seconds * rate) if seconds else sys.maxsize

    def num_frames(used: float, end: float, most: int) -> int:
        """Number of frames, up to `most`, that `prepare` selects if the time steps of the video are even."""
        # One image earlier: the grid takes an image that is up to half a step too early.
        times = (_Image(i / rate) for i in range(max(math.floor(start * rate) - 1, 0), images))
        return sum(1 for _ in islice(FrameSelection(used, start, end, rate).pick(times), most))

    every = 1
    if not wanted_rate:
        most_skipped, usual = max(math.floor(rate / LEAST_RATE), 1), usual or most
        every = max(math.ceil(num_frames(rate, end, most_skipped * usual) / usual), 1)
    used = wanted_rate or rate / every
    if (count := num_frames(used, end, most + 1)) <= most:
        return Part(used, start, end, count, True)
    # Frames lie on the grid start, start + 1 / used, ...: half a step keeps rounding from adding one.
    end = start + (most - 0.5) / used
    return Part(used, start, end, num_frames(used, end, most), False)


@dataclass(frozen=True)
class _Image:
    seconds: float


def every_kth_time(num_frames: int, most: float) -> list[float]:
    """Times in [0, 1) of every k-th frame, with the smallest k that gives at most `most` of them, or one."""
    return [i / num_frames for i in range(0, num_frames, math.ceil(num_frames / max(int(most), 1)))]


def usable_frames(num_frames: int, unexplained: list[int], cuts: list[int]) -> int:
    """Number of frames before the camera is lost or another scene begins; all of them if too few would be left.

    Args:
        unexplained: frames without a camera pose, or of another color than the clip.
        cuts: first frames after a scene cut.
    """
    missing = set(unexplained)
    lost = [i for i in missing if all(i + k in missing for k in range(LOST_FRAMES))]
    first = min([num_frames, *lost, *cuts])
    return first if first >= FEWEST_FRAMES else num_frames
