"""Atomic writes: files and folders are written to a temporary sibling, then renamed. They are complete or absent."""

from __future__ import annotations

import errno
import json
import os
import re
import shutil
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from pathlib import Path
from typing import Any

from ..core.checks import InputError, input_error

DISK_ERRORS = {errno.ENOSPC, errno.EDQUOT, errno.EFBIG, errno.EROFS, errno.EACCES, errno.EPERM, errno.EIO}
"""Errors of a disk: full, over a quota or limit, read-only, no permission, broken."""
FULL_BYTES = 2**20
"""If less is free, a write error without a reason means that the disk is full."""


class CannotWrite(InputError):
    """The disk rejects a file. A previous file at this path is unchanged."""


@contextmanager
def writing(path: Path) -> Iterator[None]:
    """Convert disk errors to an error message about `path`; other errors pass.

    Raises:
        CannotWrite: the disk is full, over a limit, read-only or broken.
    """
    try:
        yield
    except Exception as error:
        if isinstance(error, InputError) or (reason := _disk_error(error, path)) is None:
            raise
        raise CannotWrite(
            f"{path}: expected a disk that accepts this file, got {reason}. Fix: free space or choose another path, "
            "then repeat. The previous file is unchanged."
        ) from error


def _disk_error(error: Exception, path: Path) -> str | None:
    """The system's message if `error` is, or wraps, a disk error; else None."""
    number = error.errno if isinstance(error, OSError) else None
    named_file = getattr(error, "filename", None)
    if named_file and path.absolute().parent not in Path(os.fsdecode(named_file)).absolute().parents:
        return None  # an error of a file that was read
    if number is None and (match := re.search(r"os error (\d+)", str(error))):  # from a library in Rust
        number = int(match[1])
    if number in DISK_ERRORS:
        return os.strerror(number)
    with suppress(OSError):
        # Video encoders report no reason.
        if shutil.disk_usage(path.absolute().parent).free < FULL_BYTES:
            return os.strerror(errno.ENOSPC)
    return "an encoder that stopped" if isinstance(error, BrokenPipeError) else None


@contextmanager
def whole_file(path: Path) -> Iterator[Path]:
    """Yield a temporary sibling of `path` to write to; rename it to `path` on success, remove it on failure.

    The content is flushed before the rename, so that even a power cut never leaves a partial file at `path`.

    Raises:
        CannotWrite: the disk rejects the file.
    """
    # Keep the suffix last: many writers choose the format by it.
    temporary = path.with_name(f".{path.stem}.{os.getpid()}.partial{path.suffix}")
    try:
        with writing(path):
            path.parent.mkdir(parents=True, exist_ok=True)
            usual = _usual_mode(temporary)
            yield temporary
            os.chmod(temporary, usual)
            _to_disk(temporary)
            os.replace(temporary, path)
            _to_disk(path.parent)
    finally:
        temporary.unlink(missing_ok=True)


@contextmanager
def whole_folder(path: Path) -> Iterator[Path]:
    """Yield a temporary sibling folder of `path`; rename it to `path` on success, remove it on failure.

    Raises:
        InputError: `path` is not empty, or the folder cannot be created.
        CannotWrite: the disk rejects a file.
    """
    reject_current_folder(path)
    reject_occupied(path)
    temporary = path.absolute().with_name(f".{path.name}.{os.getpid()}.partial")
    try:
        shutil.rmtree(temporary, ignore_errors=True)
        temporary.mkdir(parents=True)
    except OSError as error:
        got = error.strerror or str(error)
        raise input_error(path, "a path where a folder can be created", got, "Choose another path.") from error
    try:
        with writing(path):
            yield temporary
            reject_occupied(path)
            flush_folder(temporary)
            os.replace(temporary, path)
            _to_disk(path.absolute().parent)
    finally:
        shutil.rmtree(temporary, ignore_errors=True)


def flush_folder(folder: Path) -> None:
    """Flush all files of a folder to the disk, so that a power cut does not leave empty files."""
    for place, _, files in os.walk(folder):
        for name in (*files, "."):
            _to_disk(Path(place, name))


def _usual_mode(path: Path) -> int:
    """Default permissions of a new file at `path`; some libraries create files without group permissions."""
    path.touch()
    mode = path.stat().st_mode
    path.unlink()
    return mode


def _to_disk(path: Path) -> None:
    """Flush a file, or the entries of a folder, to the disk."""
    if os.name == "nt" and path.is_dir():  # Windows does not open folders
        return
    number = os.open(path, os.O_RDONLY)
    try:
        os.fsync(number)
    finally:
        os.close(number)


def remove_leftovers(folder: Path) -> None:
    """Remove temporary files that killed processes left in `folder`."""
    for file in folder.glob(".*.partial*"):
        owner = re.search(r"\.(\d+)\.partial", file.name)
        if owner and not _alive(int(owner[1])):
            shutil.rmtree(file) if file.is_dir() else file.unlink(missing_ok=True)


def _alive(process: int) -> bool:
    try:
        os.kill(process, 0)
    except ProcessLookupError:
        return False
    except OSError:  # a process of another user
        return True
    return True


def reject_current_folder(path: Path) -> None:
    """Raise InputError if `path` is the current folder or one of its parents, which cannot be replaced."""
    if path.resolve() in (Path.cwd(), *Path.cwd().parents):
        raise input_error(path, "the name of a new folder", "one that is in use", "Choose a new name in this folder.")


def reject_occupied(path: Path, alternative: str = "", *, ignore: str | None = None) -> None:
    """Raise InputError unless `path` does not exist yet or is an empty folder.

    Args:
        alternative: another possible fix, appended to the message.
        ignore: name of a file that may exist.
    """
    try:
        if path.is_dir() and any(file.name != ignore for file in path.iterdir()):
            found = "one with files in it"
        elif not path.is_dir() and (path.exists() or path.is_symlink()):
            found = "a file"
        else:
            return
    except OSError as error:
        text = str(path)
        named = text if len(text) < 120 else f"{text[:60]}...{text[-60:]}"
        raise input_error(named, "a usable path", error.strerror or str(error), "Choose another path.") from None
    raise input_error(path, "a new or empty folder", found, f"Choose another folder{alternative}.")


def write_json(path: Path, value: Any) -> None:
    """Write `value` as indented JSON, atomically; NaN is an error because it is not JSON."""
    with whole_file(path) as temporary:
        temporary.write_text(json.dumps(value, indent=1, allow_nan=False) + "\n")
