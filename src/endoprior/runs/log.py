"""The log of a training, `log.jsonl`: how it is written, and what it says afterwards of growth and of tool masks."""

from __future__ import annotations

import json
from collections import Counter
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, Literal, TextIO

from ..core.checks import InputError, input_error, number_ranges
from ..core.config_io import from_dict
from ..core.shell import command
from ..data.found_tools import read_rows
from ..data.reading import read_bytes
from ..system.atomic import read_json_object, write_text
from ..training.trainer import Observer, Stage, StepReport, Trainer
from .folder import CONFIG, LOG

LOG_EVERY = 10  # iterations between two lines
MISSED = "missed_tool_frames"
"""Frames whose masks likely miss a tool: in the last line, in the protocol of `metrics.json` and in `StepReport`."""
"""Pixels around tool masks that were left out: in `config.json` of a run, and in the protocol of `metrics.json`."""


def log_writer(lines: TextIO) -> Observer:
    """Writes a line of JSON every `LOG_EVERY` iterations, after events of density control, and at the end."""

    def observer(report: StepReport, _trainer: Trainer) -> None:
        missed = report.missed_tool_frames
        if report.iteration % LOG_EVERY and not report.event and missed is None:
            return
        line: dict[str, Any] = {"stage": report.stage.name.lower(), "iteration": report.iteration}
        line |= {"num_gaussians": report.num_gaussians}
        line |= {"event": report.event} if report.event else {}
        line |= {MISSED: missed} if missed is not None else {}
        line |= {"terms": report.terms, "seconds": round(report.seconds, 4)}
        lines.write(json.dumps(line) + "\n")

    return observer


def cut_log(log: Path, stage: Stage, iteration: int) -> None:
    """Drop the lines of iterations after a checkpoint: they will be written again."""
    if log.exists():
        lines = read_log(log, "stage", "iteration")
        kept = [line for line in lines if (Stage[line["stage"].upper()], line["iteration"]) <= (stage, iteration)]
        write_text(log, "".join(json.dumps(line) + "\n" for line in kept))


def read_log(log: Path, *names: str) -> list[dict[str, Any]]:
    """The lines of `log.jsonl`, without a last one that a crash cut short; each must have the `names`.

    Raises:
        InputError: it cannot be read, or another line is broken: no JSON, or a value of another type.
    """
    lines, rows = read_bytes(log, "the log of a training").tobytes().splitlines(), list[dict[str, Any]]()
    for number, text in enumerate(lines, 1):
        try:
            row = json.loads(text)
        except (ValueError, RecursionError):
            row = None
        if isinstance(row, dict) and row.keys() >= set(names) and _is_line(row):
            rows.append(row)
        elif number < len(lines):
            found = ascii(text[:40].decode(errors="replace"))
            raise input_error(f"{log}, line {number}", "an iteration as JSON", found, "Remove this line.")
    return rows


@dataclass(frozen=True)
class _Line:
    """What a line of the log may hold."""

    stage: Literal["coarse", "fine"] = "fine"
    iteration: int = 0
    num_gaussians: int = 0
    event: dict[str, int] = field(default_factory=dict)
    missed_tool_frames: tuple[int, ...] = ()
    terms: dict[str, float] = field(default_factory=dict)
    seconds: float = 0.0
    window: int = 0


def _is_line(row: dict[str, Any]) -> bool:
    try:
        from_dict(_Line, row)
    except InputError:
        return False
    return True


@dataclass(frozen=True)
class Growth:
    """Counts of Gaussians, of all windows together."""

    first: int  # in the first line of the log: before any event, unless one comes within the first iterations
    last: int
    num_events: int  # events of density control
    changes: Counter[str]
    """How many Gaussians were `cloned`, `split` or removed by a rule (`removed_RULE`); 0 for what never happened."""

    @property
    def ratio(self) -> float:
        """Gaussians at the end over those at the start."""
        return self.last / self.first


def growth_of(run: Path) -> Growth | None:
    """The growth in a run folder; None without a log, or where nothing grows, as in a radiance field."""
    if not (run / LOG).is_file():
        return None
    lines = read_log(run / LOG, "num_gaussians")
    first, last = (
        sum({line.get("window", 0): line["num_gaussians"] for line in ordered}.values())
        for ordered in (reversed(lines), lines)
    )
    events, changes = [line["event"] for line in lines if "event" in line], Counter[str]()
    for event in events:
        changes.update(event)
    return Growth(first, last, len(events), changes) if first else None


def mask_facts(run: Path) -> dict[str, Any]:
    """For the protocol of `metrics.json`: what the training in a run folder found out about tool masks."""
    missed = missed_tools_of(run)
    return {} if missed is None else {MISSED: missed}


def missed_tools_of(run: Path) -> list[int] | None:
    """Frames of the sequence, ascending, in a run folder; None where training trusted the masks, or has no log."""
    if not (run / LOG).is_file():
        return None
    windows, found = _windows(_config(run)), dict[int, set[int]]()
    for line in read_log(run / LOG):
        try:
            frames, first = line[MISSED], int(windows[line["window"]][0]) if "window" in line else 0
            found[first] = {first + int(frame) for frame in frames}  # of an extended run the last line counts
        except (ValueError, KeyError, TypeError, IndexError):  # most lines
            continue
    return sorted(set().union(*found.values())) if found else None


def missed_tools_line(run: Path, data: Path) -> str:
    """What to tell the user of a run on the sequence folder `data`; empty if nothing is likely missed.

    It names the frames in which `prepare` saw something move that no mask covers, too; none where training trusted the
    masks.
    """
    if (met := missed_tools_of(run)) is None:
        return ""
    try:
        moving = {row.frame for row in read_rows(data) if row.moves_unmasked}
    except InputError:  # training is done; a damaged list must not look like its failure
        moving = set()
    if not (frames := sorted({*met, *moving})):
        return ""
    words = f"frame{'s' if len(frames) > 1 else ''} {number_ranges(frames)}"
    steps = f"`{command('view', data)}`, then `{command('train', data, 'RUN')}`"
    return f"Tools are likely missed in {words}. To look and correct: {steps}."


def _config(run: Path) -> dict[str, Any]:
    """The `config.json` of a run; empty where there is none that can be read."""
    return read_json_object(run / CONFIG) or {}


def _windows(about: dict[str, Any]) -> list[Any]:
    """First frame of each window and the one after its last, by `config.json`; none for a run of one window."""
    windows = about.get("windows")
    return windows if isinstance(windows, list) else []
