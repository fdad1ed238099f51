"""Which segment of a video becomes a model, and why: from its scan."""

from __future__ import annotations

import hashlib
import json
import math
from collections import defaultdict
from collections.abc import Mapping
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path
from types import MappingProxyType
from typing import Any

from ..core.checks import input_error
from ..core.shell import command, command_of
from ..footage.image_operations import Image
from ..prepare.first_pass import source_facts
from ..prepare.scan import scan_video
from ..prepare.segments import Stretch, as_json, best_segment, best_start, from_json, read_scan, segments_of

SCAN = "scan.json"  # file in the output folder; the timeline lies beside it
MAX_NAMED = 3  # other segments that are named


@dataclass(frozen=True)
class SegmentChoice:
    """A segment of a video, of those that its scan found."""

    scanned: dict[str, Any]  # what `scan.json` holds, with a hash of the video's identity
    number: int  # of the segment, from 1; 0 for the whole video: one segment, or none at all
    pictures: tuple[Image, ...] = ()  # a few small images of the video; none if its scan was stored

    @cached_property
    def stretches(self) -> list[Stretch]:
        """The whole video."""
        return from_json(self.scanned)

    @cached_property
    def segments(self) -> list[Stretch]:
        """Those that can become a model."""
        return segments_of(self.stretches)

    @property
    def span(self) -> tuple[float, float]:
        """Start and end of what is used, s."""
        return self.segments[self.number - 1].best if self.number else (0.0, math.inf)

    def best_start(self, seconds: float) -> float:
        """Where the best so many seconds of what is used begin, s."""
        return best_start(self.scanned, self.span, seconds)

    def words(self, video: Path, out: Path, options: Mapping[str, tuple[str, ...]] = MappingProxyType({})) -> list[str]:
        """What is used, why, and the commands for the other segments; nothing if the whole video is one segment."""
        lost: defaultdict[str, float] = defaultdict(float)
        for each in self.stretches:
            if each.reason:
                lost[each.reason] += each.seconds
        bad = ", ".join(f"{reason} {lost[reason]:.1f} s" for reason in sorted(lost, key=lambda each: -lost[each]))
        if not self.number:
            return [f"no segment of {video} is clear ({bad}), so everything is used"] if bad else []
        (start, end), ranked = self.span, sorted(range(len(self.segments)), key=lambda i: -self.segments[i].score)
        is_best = ranked[0] == self.number - 1
        why = "the most time in which tissue is clear and can be followed" if is_best else "as --segment says"
        lines = [f"segment {self.number} of {len(self.segments)} is used, {start:.1f}-{end:.1f} s: {why}"]
        whole = f"of {self.scanned['seconds']:.1f} s"
        lines.append(f"{whole}, in no segment: {bad}" if bad else f"{whole}; the rest are other scenes, or more of it")
        for i in [each for each in ranked if each != self.number - 1][:MAX_NAMED]:
            other, folder = self.segments[i], out.with_name(f"{out.name}_segment_{i + 1}")
            again = command_of("run", (video, folder), {**options, "--segment": (str(i + 1),)})
            lines.append(f"  {other.best[0]:.1f}-{other.best[1]:.1f} s, score {other.score:.1f}: `{again}`")
        return [
            *lines,
            f"every segment: --all-segments with another OUT; the timeline: {(out / SCAN).with_suffix('.png')}",
        ]


def choose_segment(video: Path, out: Path, folder_rate: float | None, wanted: int = 0) -> SegmentChoice:
    """Scan a video, unless `out` or the folder around it holds its scan; choose the wanted segment, or the best for 0.

    Raises:
        InputError: the video cannot be read, or has no such segment.
    """
    facts = json.dumps(source_facts(video) | {"folder_rate": folder_rate})
    identity = hashlib.sha256(facts.encode()).hexdigest()  # its name may be that of a patient
    stored = [read_scan(folder / SCAN) for folder in (out, out.parent) if (folder / SCAN).is_file()]
    scanned, pictures = next((each for each in stored if each.get("video") == identity), None), ()
    if scanned is None:
        scan = scan_video(video, folder_rate)
        scanned, pictures = as_json(scan) | {"video": identity}, tuple(scan.pictures)
    choice = SegmentChoice(scanned, 0, pictures)
    count, is_whole = len(choice.segments), len(choice.stretches) == 1
    if not 0 <= wanted <= max(count, 1):
        got = f"{wanted}, with {count} in {video}"
        raise input_error("--segment", "the number of a segment", got, f"`{command('scan', video)}` lists them.")
    if not count or is_whole:
        return choice
    return SegmentChoice(scanned, wanted or best_segment(choice.segments) + 1, pictures)
