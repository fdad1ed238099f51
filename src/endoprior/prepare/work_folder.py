"""A resumable output folder: hidden next to its target until it is complete."""

from __future__ import annotations

import json
import shutil
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

from ..core.checks import InputError, input_error
from ..system.atomic import (
    CannotWrite,
    complete_folder,
    read_json_object,
    reject_current_folder,
    reject_occupied,
    write_json,
    writing,
)
from ..system.file_lock import locked

PLAN = "plan.json"  # inputs and options of the folder. If they changed, the work starts from the beginning.


@contextmanager
def work_folder(out: Path, plan: dict[str, Any]) -> Iterator[Path]:
    """Yield the hidden folder of `out`, with the files of an interrupted run of the same plan.

    When the block ends normally, the folder is renamed to `out`. On `InputError` it is removed. On any other failure,
    such as Ctrl-C or a full disk, it stays for the next run.

    Args:
        plan: JSON values that determine every byte of the output.
    Raises:
        InputError: `out` is not empty, another process is writing it, or the folder cannot be created.
    """
    reject_occupied(out)
    reject_current_folder(out)
    folder = _work_folder(out)
    try:
        folder.parent.mkdir(parents=True, exist_ok=True)
    except OSError as error:
        got = error.strerror or str(error)
        raise input_error(out, "a path where a folder can be created", got, "Choose another path.") from None
    with locked(out, work_lock(out)):
        try:
            if read_json_object(folder / PLAN) != json.loads(json.dumps(plan)):
                shutil.rmtree(folder, ignore_errors=True)
                folder.mkdir()
                write_json(folder / PLAN, plan)
            with writing(out):
                yield folder
                delete_plan(folder)
                complete_folder(folder, out)
        except CannotWrite:
            raise
        except InputError:
            shutil.rmtree(folder, ignore_errors=True)
            raise


def work_lock(out: Path) -> Path:
    """The lock that a process holds while it prepares `out`."""
    folder = _work_folder(out)
    return folder.with_name(folder.name + ".lock")


def _work_folder(out: Path) -> Path:
    return out.absolute().with_name(f".{out.name}.endoprior.preparing")


def delete_plan(folder: Path) -> None:
    """Make an interrupted run start from the beginning, because the next step cannot be repeated."""
    (folder / PLAN).unlink(missing_ok=True)


def frames_done(folder: Path, parts: list[str]) -> int:
    """Number of complete frames of an interrupted run; the last frame may be incomplete and does not count."""
    return max(min(len(list((folder / part).glob("*.png"))) for part in parts) - 1, 0)
