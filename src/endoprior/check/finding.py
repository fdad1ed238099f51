"""One problem of a sequence, and the words of its fix: an edit, or a command or options of one."""

from __future__ import annotations

from dataclasses import dataclass
from itertools import pairwise
from pathlib import Path
from typing import Any, Literal

from ..core.checks import number_ranges, read_ranges
from ..core.config import DataConfig
from ..core.shell import command
from ..data import FrameSequence
from ..data.description import PrepareRecord, read_description, read_record

Severity = Literal["error", "warning", "note"]
MIN_TRAINING_FRAMES = 2  # Training needs as many


@dataclass(frozen=True)
class About:
    """What is known of a sequence before its frames are looked at: fixes are worded by it."""

    path: Path
    frames: int  # T
    described: dict[str, Any]  # content of `sequence.json`; empty without one
    sources: dict[str, str]  # where each part comes from, if the folder states it
    data: DataConfig  # options with which the sequence was opened
    record: PrepareRecord | None  # how `prepare` made the folder, if it did

    @property
    def depth_scale(self) -> float:
        """Mm per stored unit of depth: the option, else the value in `sequence.json`, else 1."""
        return float(self.data.depth_unit_mm or self.described.get("depth_scale") or 1.0)


def about_sequence(sequence: FrameSequence, cfg: DataConfig) -> About:
    """What is known of a sequence that was opened with these options, without its frames."""
    described, record = read_description(sequence.path / "sequence.json"), read_record(sequence.path)
    return About(sequence.path, len(sequence), described, dict(sequence.sources), cfg, record)


@dataclass(frozen=True)
class Finding:
    """One problem of a sequence."""

    code: str  # Stable name
    severity: Severity
    """`error`: training would fail or learn something wrong; `warning`: it costs quality; `note`: good to know."""
    what: str  # The problem, on one line
    fix: str
    """What to do: an edit, or a command or options of one in backticks. Numbers of frames are those of this check."""
    frames: tuple[int, ...] = ()  # Affected frames; empty for all

    def __str__(self) -> str:
        return f"{self.severity}: {self.code}: {self.what}. Fix: {self.fix}"


def set_values(about: About, **values: Any) -> str:
    """The edit that sets entries of `sequence.json`; it may not exist yet."""
    entries = ", ".join(f'"{name}": {value}' for name, value in values.items())
    file = about.path / "sequence.json"
    return f"set {entries} in {file}" if about.described else f"write {{{entries}}} to {file}"


def skip(about: About, frames: tuple[int, ...]) -> str:
    """Train without some frames; a look at the files if too few are left."""
    if about.frames - len(set(frames)) < MIN_TRAINING_FRAMES:
        return f"look at the images in {about.path}: they may not be one video of one scene"
    before = read_ranges("skip_frames", about.data.skip_frames)
    # Positions of the frames of this check among those that it would have without `skip_frames`.
    places = [place for place in range(about.frames + len(before)) if place not in before]
    left_out = sorted({*before, *(places[frame] for frame in frames)})
    return f"train with `--data.skip-frames {number_ranges(left_out, len(left_out)).replace(' ', '')}`"


def longest_part(about: About, jumps: tuple[int, ...]) -> str:
    """Train on the longest part between jumps, each the first frame of a part."""
    first, end = max(pairwise([0, *jumps, about.frames]), key=lambda part: part[1] - part[0])
    if first == 0 and not about.data.skip_frames:
        return f"train with `--data.first-frames {end}`"
    return skip(about, (*range(first), *range(end, about.frames)))


def convert_poses(about: About, convention: str, unit: float) -> str:
    """The command that reads the stored poses in another convention, in the folder itself where that is possible."""
    file = about.path / "poses_bounds.npy"
    if not file.is_file():
        return "store camera-to-world matrices in mm with OpenCV axes (x right, y down, z forward)"
    options = ["--poses-convention", convention] if convention != "opencv" else []
    options += ["--poses-unit-mm", f"{unit:.4g}"] if unit != 1 else []
    in_place = command("poses", about.path, "--poses", file, *options)
    return f"`{in_place}`, which keeps the old ones in poses_bounds_before.npy"
