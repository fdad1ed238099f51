"""Files and folders that appear whole or not at all: written beside their place, then renamed."""

from __future__ import annotations

import json
import os
import shutil
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

from .checks import InputError


@contextmanager
def whole_file(path: Path) -> Iterator[Path]:
    """Yield a temporary sibling of `path` to write to; rename it onto `path` on success, remove it on failure."""
    path.parent.mkdir(parents=True, exist_ok=True)
    # The suffix stays last, because many writers choose their format by it.
    temporary = path.with_name(f".{path.stem}.{os.getpid()}.partial{path.suffix}")
    try:
        yield temporary
        with open(temporary, "rb") as written:
            os.fsync(written.fileno())
        os.replace(temporary, path)
    finally:
        temporary.unlink(missing_ok=True)


@contextmanager
def whole_folder(path: Path) -> Iterator[Path]:
    """Yield a temporary sibling folder of `path`; rename it onto `path` on success, remove it on failure.

    Raises:
        InputError: `path` is in use, or no folder can be made there.
    """
    refuse_occupied(path)
    temporary = path.absolute().with_name(f".{path.name}.{os.getpid()}.partial")
    try:
        shutil.rmtree(temporary, ignore_errors=True)
        temporary.mkdir(parents=True)
    except OSError as error:
        raise InputError(
            f"{path}: expected a place where a folder can be made; got {error.strerror}. Choose another."
        ) from error
    try:
        yield temporary
        refuse_occupied(path)
        os.replace(temporary, path)
    finally:
        shutil.rmtree(temporary, ignore_errors=True)


def refuse_occupied(path: Path, otherwise: str = "") -> None:
    """Raise InputError unless `path` does not exist yet or is an empty folder.

    Args:
        otherwise: what else the user could do, appended to the message.
    """
    if path.is_dir() and any(path.iterdir()):
        found = "one with files in it"
    elif not path.is_dir() and (path.exists() or path.is_symlink()):
        found = "a file"
    else:
        return
    raise InputError(f"{path}: expected a new or empty folder; got {found}. Choose another{otherwise}.")


def write_json(path: Path, value: Any) -> None:
    """Write `value` as indented JSON, whole or not at all; NaN is refused (it is not JSON)."""
    with whole_file(path) as temporary:
        temporary.write_text(json.dumps(value, indent=1, allow_nan=False) + "\n")
