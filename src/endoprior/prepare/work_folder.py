"""A folder that is written over hours and may be interrupted: hidden beside its target until it is complete."""

from __future__ import annotations

import json
import os
import shutil
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

from filelock import FileLock, Timeout

from ..core.checks import InputError
from ..system.atomic import CannotWrite, flush_folder, refuse_current, refuse_occupied, write_json, writing

PLAN = "plan.json"
"""What the folder is being made from; another plan starts from nothing."""


@contextmanager
def work_folder(out: Path, plan: dict[str, Any]) -> Iterator[Path]:
    """Yield the hidden folder for `out`, with what an interrupted run of the same plan left in it.

    When the block ends normally the folder takes the name `out`. On `InputError` it is removed; on anything else,
    such as Ctrl-C or a full disk, it stays for the next run.

    Args:
        plan: JSON values that decide every byte that will be written.
    Raises:
        InputError: `out` is in use, or another process is writing it, or no folder can be made there.
    """
    refuse_occupied(out)
    refuse_current(out)
    folder = out.absolute().with_name(f".{out.name}.preparing")
    try:
        folder.parent.mkdir(parents=True, exist_ok=True)
        lock = FileLock(folder.with_name(folder.name + ".lock"))
        lock.acquire(timeout=0)
    except Timeout:
        raise InputError(f"{out}: expected no other process to write it; one does. Wait, or choose another.") from None
    except OSError as error:
        got = error.strerror or str(error)
        raise InputError(f"{out}: expected a place where a folder can be made; got {got}. Choose another.") from None
    try:
        if _plan_of(folder) != json.loads(json.dumps(plan)):
            shutil.rmtree(folder, ignore_errors=True)
            folder.mkdir()
            write_json(folder / PLAN, plan)
        with writing(out):
            yield folder
            forget_plan(folder)
            refuse_occupied(out)
            flush_folder(folder)
            os.replace(folder, out)
    except CannotWrite:
        raise
    except InputError:
        shutil.rmtree(folder, ignore_errors=True)
        raise
    finally:
        lock.release()
        Path(lock.lock_file).unlink(missing_ok=True)


def forget_plan(folder: Path) -> None:
    """From now on an interrupted run starts from nothing: what follows cannot be done twice."""
    (folder / PLAN).unlink(missing_ok=True)


def _plan_of(folder: Path) -> Any:
    try:
        return json.loads((folder / PLAN).read_text(encoding="utf-8"))
    except (OSError, ValueError):
        return None


def frames_done(folder: Path, parts: list[str]) -> int:
    """Frames that an interrupted run left complete: all but the last one of those that every part has."""
    counts = [len(list((folder / part).glob("*.png"))) for part in parts]
    return max(min(counts) - 1, 0)
