"""Which stretches of a scanned video one model can show, how good each is, and what is wrong between them."""

from __future__ import annotations

from dataclasses import dataclass, replace
from itertools import groupby, pairwise
from pathlib import Path
from typing import Any

import numpy as np

from ..core.checks import input_error
from ..data.reading import of_type, read_json, read_parts
from ..footage.disturbances import FrameQuality
from ..footage.image_operations import runs
from .scan import Scan, ScannedFrame

SHORTEST_S = 1.0  # a segment is at least so long, s
TOLERATED_S = 0.5  # a disturbance that is shorter does not end a segment, s
LONGEST_S = 30.0  # most of a segment that counts, and that is used unless it is the whole video, s
UNKNOWN_MOTION = 0.5  # how far an image counts whose motion is unknown
CUT, SHORT = "scene change", "too short"
WORDS: tuple[str, ...] = ("smoke", "blur", "dark", "overexposed", "out of the body", "repeated frames", CUT, SHORT)
"""What keeps a stretch from being a segment."""


@dataclass(frozen=True)
class Stretch:
    """A part of a video that is a segment, or not."""

    start: float  # time of its first image, s
    end: float  # s, not included
    reason: str = ""  # one of `WORDS`; empty for a segment
    score: float = 0.0  # of a segment: seconds of its best `LONGEST_S`, less where they are disturbed
    best: tuple[float, float] = (0.0, 0.0)
    """Start and end of that part, s."""

    @property
    def seconds(self) -> float:
        """Its length, s."""
        return self.end - self.start


def stretches_of(scan: Scan) -> list[Stretch]:
    """The whole video in stretches, in order."""
    frames = scan.frames
    if not frames:
        return []
    edges = [0.0, *scan.cuts, scan.seconds]
    times = np.array([frame.seconds for frame in frames])
    found = list[Stretch]()
    for start, end in pairwise(edges):
        first, last = np.searchsorted(times, [start - 1e-6, end - 1e-6])
        found += _of_scene(frames[first:last], start, end)
    return found


def segments_of(stretches: list[Stretch]) -> list[Stretch]:
    """Those of which a model is possible, in order."""
    return [each for each in stretches if not each.reason]


def best_segment(segments: list[Stretch]) -> int:
    """Position of the one with the best score, the first of equals."""
    return max(range(len(segments)), key=lambda i: (round(segments[i].score, 2), -i))


def _of_scene(frames: list[ScannedFrame], start: float, end: float) -> list[Stretch]:
    """The stretches between two cuts."""
    if not frames:
        return [Stretch(start, end, SHORT)]
    words = [frame.word for frame in frames]
    edges = [start, *(frame.seconds for frame in frames[1:]), end]  # frame i lasts from edge i to edge i + 1
    disturbed = np.array([bool(word) for word in words])
    for first, last in runs(disturbed):
        if edges[last] - edges[first] < TOLERATED_S and 0 < first and last < len(frames):
            disturbed[first:last] = False
    found = list[Stretch]()
    for is_bad, first, last in sorted(
        [(True, *run) for run in runs(disturbed)] + [(False, *run) for run in runs(~disturbed)], key=lambda run: run[1]
    ):
        start, end = edges[first], edges[last]
        if is_bad:
            found += _not_usable(words[first:last], edges[first : last + 1])
        elif end - start < SHORTEST_S:
            found.append(Stretch(start, end, SHORT))
        else:
            found.append(_segment(frames[first:last], edges[first : last + 1]))
    return found


def _not_usable(words: list[str], edges: list[float]) -> list[Stretch]:
    """A disturbed stretch, cut where another disturbance takes over for longer than `TOLERATED_S`."""
    found = list[Stretch]()
    for word, group in groupby(range(len(words)), lambda i: words[i]):
        places = list(group)
        start, end = edges[places[0]], edges[places[-1] + 1]
        if found and (word in ("", found[-1].reason) or end - start < TOLERATED_S):
            found[-1] = replace(found[-1], end=end)
        else:
            found.append(Stretch(start, end, word or words[places[-1] + 1]))
    return found


def _segment(frames: list[ScannedFrame], edges: list[float]) -> Stretch:
    """A segment with its score and its best part."""
    lasts = np.diff(edges)
    known = np.array([frame.motion is not None for frame in frames])
    known[:1] = True  # the first image follows nothing
    worth = np.concatenate(
        [[0.0], np.cumsum(lasts * [frame.weight for frame in frames] * np.where(known, 1, UNKNOWN_MOTION))]
    )
    ends = np.searchsorted(edges, np.array(edges) + LONGEST_S + 1e-6, side="right") - 1
    scores = worth[ends] - worth
    first = int(np.argmax(np.round(scores, 2)))
    return Stretch(edges[0], edges[-1], "", float(scores[first]), (edges[first], edges[ends[first]]))


def as_json(scan: Scan) -> dict[str, Any]:
    """What `scan.json` holds."""
    stretches = stretches_of(scan)
    segments = segments_of(stretches)
    return {
        "format_version": 1,
        "seconds": round(scan.seconds, 3),
        "looks_per_second": round(scan.rate, 3),
        "best_segment": best_segment(segments) + 1 if segments else None,
        "segments": [
            {
                "number": number, "start": round(each.start, 3), "end": round(each.end, 3),
                "score": round(each.score, 2), "used": [round(time, 3) for time in each.best],
            }
            for number, each in enumerate(segments, 1)
        ],
        "not_usable": [
            {"start": round(each.start, 3), "end": round(each.end, 3), "reason": each.reason}
            for each in stretches
            if each.reason
        ],
        "cuts": [round(time, 3) for time in scan.cuts],
        "looks": {
            "seconds": [round(frame.seconds, 3) for frame in scan.frames],
            "problem": [frame.word for frame in scan.frames],
            "weight": [round(frame.weight, 3) for frame in scan.frames],
            "shift": [None if frame.motion is None else round(frame.motion.shift, 4) for frame in scan.frames],
            "residual": [None if frame.motion is None else round(frame.motion.residual, 5) for frame in scan.frames],
            **{
                name: [round(frame.quality[k], 4) for frame in scan.frames]
                for k, name in enumerate(scan.frames[0].quality._fields if scan.frames else ())
            },
        },
    }  # fmt: skip


@dataclass(frozen=True)
class _Segment:
    """One of `segments` in `scan.json`."""

    number: int
    start: float
    end: float
    score: float
    used: tuple[float, float]


@dataclass(frozen=True)
class _NotUsable:
    """One of `not_usable` in `scan.json`."""

    start: float
    end: float
    reason: str


def read_scan(file: Path) -> dict[str, Any]:
    """What `as_json` gave, from a file that holds it; it may come from somebody else.

    Raises:
        InputError: it cannot be a scan.
    """
    fix = "remove it, and repeat the command: the video is scanned again."
    numbers = tuple[float, ...]
    looks: dict[str, Any] = dict.fromkeys(("seconds", "weight", *FrameQuality._fields), numbers)
    looks |= {"problem": tuple[str, ...], "shift": tuple[float | int | None, ...]}
    parts = {"seconds": float, "segments": tuple[_Segment, ...], "not_usable": tuple[_NotUsable, ...], "cuts": numbers}
    checked = read_parts(file, parts | {"looks": dict[str, list]}, fix)
    for name, hint in looks.items():
        of_type(file, hint, checked["looks"].get(name), f"looks.{name}", fix)
    if len({len(values) for values in checked["looks"].values()}) != 1:
        raise input_error(file, "lists of one length in looks", "others", fix)
    if unknown := {each.reason for each in checked["not_usable"]} - {*WORDS}:
        raise input_error(file, f"a reason of {', '.join(WORDS)}", min(unknown), fix)
    return read_json(file, fix)


def best_start(scanned: dict[str, Any], span: tuple[float, float], seconds: float) -> float:
    """Where so many seconds of a span are clearest and can be followed best, s; the first of nearly equal places.

    Args:
        scanned: what `as_json` gave. span: start and end, s.
    """
    looks = scanned["looks"]
    times = np.array(looks["seconds"])
    inside = np.flatnonzero((times >= span[0] - 1e-6) & (times < span[1] - 1e-6))
    if not len(inside):
        return span[0]
    known = np.array([looks["shift"][i] is not None for i in inside])
    known[:1] = True
    clear = np.array([looks["weight"][i] * (not looks["problem"][i]) for i in inside])
    worth = np.concatenate([[0.0], np.cumsum(clear * np.where(known, 1, UNKNOWN_MOTION))])
    starts = times[inside]
    ends = np.searchsorted(starts, starts + seconds - 1e-6)
    fits = starts + seconds <= min(span[1], scanned["seconds"]) + 1e-6
    mean = (worth[ends] - worth[:-1])[fits] / np.maximum(ends - np.arange(len(ends)), 1)[fits]
    return float(starts[fits][np.argmax(np.round(mean, 2))]) if len(mean) else span[0]


def from_json(scanned: dict[str, Any]) -> list[Stretch]:
    """The stretches of a video, in order, from what `as_json` gave."""
    good = [Stretch(each["start"], each["end"], "", each["score"], tuple(each["used"])) for each in scanned["segments"]]
    bad = [Stretch(each["start"], each["end"], each["reason"]) for each in scanned["not_usable"]]
    return sorted(good + bad, key=lambda each: each.start)
