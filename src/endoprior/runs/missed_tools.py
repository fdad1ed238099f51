"""In which frames a training met tools that the masks miss, by its log."""

from __future__ import annotations

import json
from pathlib import Path

from ..core.checks import InputError, number_ranges
from ..core.shell import command
from ..data.found_tools import read_rows
from .folder import CONFIG, LOG, read_log

KEY = "missed_tool_frames"
"""In the last line of the log, in the protocol of `metrics.json` and in `StepReport`."""


def missed_tools_of(run: Path) -> list[int] | None:
    """Frames of the sequence, ascending, in a run folder; None where training trusted the masks, or has no log."""
    log = run / LOG
    if not log.is_file():
        return None
    starts, found = _window_starts(run), None
    for line in read_log(log):
        try:
            frames, first = line[KEY], starts[line["window"]] if "window" in line else 0
            found = (found or set()) | {first + int(frame) for frame in frames}
        except (ValueError, KeyError, TypeError, IndexError):  # most lines
            continue
    return None if found is None else sorted(found)


def missed_tools_line(run: Path, data: Path) -> str:
    """What to tell the user of a run on the sequence folder `data`; empty if nothing is likely missed.

    It names the frames in which `prepare` saw something move that no mask covers, too; none where training trusted the
    masks.
    """
    met = missed_tools_of(run)
    frames = [] if met is None else sorted({*met, *_moving(data)})
    if not frames:
        return ""
    words = f"frame{'s' if len(frames) > 1 else ''} {number_ranges(frames)}"
    return f"Tools are likely missed in {words}. To look and correct: `{command('view', data)}`, then train again."


def _moving(data: Path) -> list[int]:
    try:
        return [row.frame for row in read_rows(data) if row.moves_unmasked]
    except InputError:  # training is done; a damaged list must not look like its failure
        return []


def _window_starts(run: Path) -> list[int]:
    """First frame of each window; none for a run of one window."""
    try:
        plan = json.loads((run / CONFIG).read_text(encoding="utf-8")).get("windows", [])
        return [int(start) for start, _ in plan]
    except (OSError, ValueError, TypeError, AttributeError):
        return []
