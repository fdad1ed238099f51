"""Files and folders that appear whole or not at all: written beside their place, then renamed."""

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

from ..core.checks import InputError

REFUSALS = {errno.ENOSPC, errno.EDQUOT, errno.EFBIG, errno.EROFS, errno.EACCES, errno.EPERM, errno.EIO}
"""Why a system does not take what is written: full, over a quota or limit, read-only, forbidden, broken."""
FULL_BYTES = 2**20
"""With less than this free, a writer that failed without saying why failed because the disk is full."""


class CannotWrite(InputError):
    """The disk does not take a file. What was at its place before is whole."""


@contextmanager
def writing(path: Path) -> Iterator[None]:
    """Turn the failure of a disk into one line about `path`; other errors pass.

    Raises:
        CannotWrite: the disk is full, over a limit, read-only or broken.
    """
    try:
        yield
    except Exception as error:
        if isinstance(error, InputError) or (refusal := _refusal(error, path)) is None:
            raise
        raise CannotWrite(
            f"{path}: expected a disk that takes this file; got {refusal}. Make room or choose another place, "
            "and repeat; what was there before is whole."
        ) from error


def _refusal(error: Exception, path: Path) -> str | None:
    """The system's words if `error` is a disk's refusal, however deep it was wrapped; else None."""
    number = error.errno if isinstance(error, OSError) else None
    elsewhere = getattr(error, "filename", None)
    if elsewhere and path.absolute().parent not in Path(os.fsdecode(elsewhere)).absolute().parents:
        return None  # a file that was read
    if number is None and (named := re.search(r"os error (\d+)", str(error))):  # a library in Rust
        number = int(named[1])
    if number in REFUSALS:
        return os.strerror(number)
    with suppress(OSError):
        # Encoders only say that they stopped.
        if shutil.disk_usage(path.absolute().parent).free < FULL_BYTES:
            return os.strerror(errno.ENOSPC)
    return "an encoder that stopped" if isinstance(error, BrokenPipeError) else None


@contextmanager
def whole_file(path: Path) -> Iterator[Path]:
    """Yield a temporary sibling of `path` to write to; rename it onto `path` on success, remove it on failure.

    Contents reach the disk before the name does, so that not even a power cut leaves a part of a file at `path`.

    Raises:
        CannotWrite: the disk does not take it.
    """
    # The suffix stays last, because many writers choose their format by it.
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
    """Yield a temporary sibling folder of `path`; rename it onto `path` on success, remove it on failure.

    Raises:
        InputError: `path` is in use, or no folder can be made there.
        CannotWrite: the disk does not take what is written.
    """
    reject_current_folder(path)
    reject_occupied(path)
    temporary = path.absolute().with_name(f".{path.name}.{os.getpid()}.partial")
    try:
        shutil.rmtree(temporary, ignore_errors=True)
        temporary.mkdir(parents=True)
    except OSError as error:
        raise InputError(
            f"{path}: expected a place where a folder can be made; got {error.strerror}. Choose another."
        ) from error
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
    """Wait until everything in a folder is on the disk: a power cut must not leave names of empty files."""
    for place, _, files in os.walk(folder):
        for name in (*files, "."):
            _to_disk(Path(place, name))


def _usual_mode(path: Path) -> int:
    """Permissions of a file that is made at `path`; some libraries give nobody else any."""
    path.touch()
    mode = path.stat().st_mode
    path.unlink()
    return mode


def _to_disk(path: Path) -> None:
    """Wait until a file, or the names in a folder, are on the disk and not only in memory."""
    if os.name == "nt" and path.is_dir():  # Windows does not open folders
        return
    number = os.open(path, os.O_RDONLY)
    try:
        os.fsync(number)
    finally:
        os.close(number)


def remove_leftovers(folder: Path) -> None:
    """Remove what killed processes were writing in `folder` when they died."""
    for file in folder.glob(".*.partial*"):
        owner = re.search(r"\.(\d+)\.partial", file.name)
        if owner and not _alive(int(owner[1])):
            shutil.rmtree(file) if file.is_dir() else file.unlink(missing_ok=True)


def _alive(process: int) -> bool:
    try:
        os.kill(process, 0)
    except ProcessLookupError:
        return False
    except OSError:  # somebody else's process
        return True
    return True


def reject_current_folder(path: Path) -> None:
    """Raise InputError if `path` is the current folder or one above: it cannot be replaced by another one."""
    if path.resolve() in (Path.cwd(), *Path.cwd().parents):
        raise InputError(f"{path}: expected the name of a new folder; got one that is in use. Choose a name in it.")


def reject_occupied(path: Path, otherwise: str = "", *, spare: str | None = None) -> None:
    """Raise InputError unless `path` does not exist yet or is an empty folder.

    Args:
        otherwise: what else the user could do, appended to the message.
        spare: name of a file that does not count.
    """
    try:
        if path.is_dir() and any(file.name != spare for file in path.iterdir()):
            found = "one with files in it"
        elif not path.is_dir() and (path.exists() or path.is_symlink()):
            found = "a file"
        else:
            return
    except OSError as error:
        text = str(path)
        named = text if len(text) < 120 else f"{text[:60]}...{text[-60:]}"
        raise InputError(f"{named}: expected a usable path; got {error.strerror}. Choose another.") from None
    raise InputError(f"{path}: expected a new or empty folder; got {found}. Choose another{otherwise}.")


def write_json(path: Path, value: Any) -> None:
    """Write `value` as indented JSON, whole or not at all; NaN is refused (it is not JSON)."""
    with whole_file(path) as temporary:
        temporary.write_text(json.dumps(value, indent=1, allow_nan=False) + "\n")
