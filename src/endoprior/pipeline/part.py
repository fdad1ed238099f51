"""Choose the part of a video that one scene can show. Pure functions."""

from __future__ import annotations

import math
from collections.abc import Sequence
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
    times: Sequence[float],
    rate: float,
    wanted_rate: float,
    start: float,
    end: float,
    most: int,
    usual: int | None = None,
) -> Part:
    """The first part of a video that has at most `most` frames.

    A long video loses frames in between, down to `LEAST_RATE`, until it has at most `usual`, then its end.

    Args:
        usual: None: `most`.
        times: when each image of the video is shown, s, ascending.
        rate: usual one of the video, 1/s.
        wanted_rate: rate that the user chose, 1/s; 0 for none.
        start, end: times that the user chose; the end may be infinite.
    """

    def chosen(used: float, most: int) -> list[float]:
        """Times of the frames, up to `most`, that `prepare` selects."""
        picked = FrameSelection(used, start, end, rate).pick(map(_Image, times))
        return [image.seconds for image in islice(picked, most)]

    every = 1
    if not wanted_rate:
        most_skipped, usual = max(math.floor(rate / LEAST_RATE), 1), usual or most
        every = max(math.ceil(len(chosen(rate, most_skipped * usual)) / usual), 1)
    used = wanted_rate or rate / every
    frames = chosen(used, most + 1)
    if len(frames) <= most:
        return Part(used, start, end, len(frames), True)
    end = end_after(frames[most - 1], start, used)
    return Part(used, start, end, sum(time < end - 1e-9 for time in frames), False)


def end_after(time: float, start: float, rate: float) -> float:
    """The `--end` that keeps the frame at a time and none after it, on the grid start, start + 1 / rate, ..."""
    # Half a step keeps rounding from adding one.
    return start + (round((time - start) * rate) + 0.5) / rate


def end_of_first(times: Sequence[float], source_rate: float, part: Part, count: int) -> float:
    """The `--end` of the first `count` frames of a part, or of all if it has fewer. Args: as `choose_part`."""
    selection = FrameSelection(part.frames_per_second, part.start, part.end, source_rate)
    picked = [image.seconds for image in islice(selection.pick(map(_Image, times)), count)]
    return end_after(picked[-1], part.start, part.frames_per_second) if picked else part.end


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
