"""The run folder: whether it can take a run, and who may write to it."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

from ..core.checks import InputError, input_error
from ..core.shell import command
from ..data.reading import kind_of, read_bytes
from ..system.atomic import is_leftover, reject_occupied

LOCK = ".lock"
"""File that a process holds while it trains in a folder."""
CONFIG, LOG, CHECKPOINT, SCENE = "config.json", "log.jsonl", "checkpoint.safetensors", "scene.safetensors"
"""Names of its files."""


def reject_unusable_folder(out: Path, *, resume: bool) -> None:
    """Reject a folder that cannot take a run; nothing is created yet.

    Raises:
        InputError: it is a file, or it holds something and `resume` is False, or its name is not usable.
    """
    exists = kind_of(out) == "a folder"
    if not (resume and exists):
        is_run = exists and (out / CONFIG).is_file()
        resume_it = f", or resume the run in it: `{command('train', '--resume', out)}`" if is_run else ""
        reject_occupied(out, resume_it, ignore=lambda file: file.name == LOCK or is_leftover(file))


def prepare_run_folder(out: Path, *, resume: bool) -> bool:
    """Make sure that `out` exists and can take a run.

    Returns:
        Whether the folder is new.
    Raises:
        InputError: as `reject_unusable_folder`, or it cannot be made.
    """
    reject_unusable_folder(out, resume=resume)
    existed = out.is_dir()
    try:
        out.mkdir(parents=True, exist_ok=True)
    except OSError as error:
        raise InputError(f"{out}: expected a place for a folder, got {error.strerror}. Fix: Choose another.") from error
    return not existed


def read_log(log: Path, *names: str) -> list[dict[str, Any]]:
    """The lines of `log.jsonl`, without a last one that a crash cut short.

    Args:
        names: what each line must have.
    Raises:
        InputError: it cannot be read, or another line is broken.
    """
    lines, rows = read_bytes(log, "the log of a training").tobytes().splitlines(), list[dict[str, Any]]()
    for number, text in enumerate(lines, 1):
        try:
            row = json.loads(text)
        except (ValueError, RecursionError):
            row = None
        if isinstance(row, dict) and row.keys() >= set(names):
            rows.append(row)
        elif number < len(lines):
            found = ascii(text[:40].decode(errors="replace"))
            raise input_error(f"{log}, line {number}", "an iteration as JSON", found, "Remove this line.")
    return rows
