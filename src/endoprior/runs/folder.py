"""The run folder: whether it can take a run, and who may write to it."""

from __future__ import annotations

from pathlib import Path

from ..core.checks import InputError
from ..core.shell import command
from ..data.reading import kind_of
from ..system.atomic import reject_occupied, remove_leftovers

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
    if exists:
        remove_leftovers(out)
    if not (resume and exists):
        is_run = exists and (out / CONFIG).is_file()
        resume_it = f", or resume the run in it: `{command('train', '--resume', out)}`" if is_run else ""
        reject_occupied(out, resume_it, ignore=LOCK)


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
