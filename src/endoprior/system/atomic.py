"""Atomic writes: files and folders are written to a temporary sibling, then renamed. They are complete or absent."""

from __future__ import annotations

import errno
import hashlib
import json
import os
import re
import shutil
import socket
import sys
import time as clock
import uuid
from collections.abc import Callable, Iterator
from contextlib import contextmanager, suppress
from functools import cache
from pathlib import Path
from typing import Any

from ..core.checks import InputError, input_error, printable

DISK_ERRORS = {
    getattr(errno, name)
    for name in (
        *("ENOSPC", "EDQUOT", "EFBIG", "EROFS", "EACCES", "EPERM", "EIO", "ENODEV", "ENXIO"),
        *("ESTALE", "ETIMEDOUT", "ENOTCONN", "EHOSTDOWN", "EHOSTUNREACH", "ENETDOWN", "ENETUNREACH", "EREMOTEIO"),
    )
    if hasattr(errno, name)
}
"""Errors of a disk: full, over a quota or limit, read-only, no permission, broken; and a network drive that is gone."""
FULL_BYTES = 2**20
"""If less is free, a write error without a reason means that the disk is full."""
NO_FOLDER_FLUSH = {errno.EACCES, errno.EBADF, errno.EINVAL, errno.ENOTSUP}
"""Answers of systems that do not flush folders: Windows does not open them, some network drives only open them."""
RENAME_WAITS_S = (0.05, 0.1, 0.2, 0.4, 0.8)
"""Waits between attempts to rename on Windows, where a virus scanner can hold a new file open for a moment."""


class CannotWrite(InputError):
    """The disk rejects a file. A previous file at this path is unchanged."""


@contextmanager
def writing(path: Path) -> Iterator[None]:
    """Raise CannotWrite for `path` if the disk is full, over a limit, read-only or broken; other errors pass."""
    try:
        yield
    except Exception as error:
        if isinstance(error, InputError) or (reason := _disk_error(error, path)) is None:
            raise
        fix = "Close other programs that use it" if isinstance(error, PermissionError) else "Free space"
        raise CannotWrite(
            f"{path}: expected a disk that accepts this file, got {reason}. Fix: {fix} or choose another path, "
            "then repeat. The previous file is unchanged."
        ) from error


def _disk_error(error: Exception, path: Path) -> str | None:
    """The system's message if `error` is, or wraps, a disk error; else None."""
    named_file = getattr(error, "filename", None)
    if named_file and path.absolute().parent not in Path(os.fsdecode(named_file)).absolute().parents:
        return None  # an error of a file that was read
    number = error.errno if isinstance(error, OSError) else None
    if number is None and (match := re.search(r"os error (\d+)", str(error))):  # from a library in Rust
        number = int(match[1])
    if number in DISK_ERRORS:
        return os.strerror(number or 0)
    with suppress(OSError):
        # Video encoders report no reason.
        if shutil.disk_usage(path.absolute().parent).free < FULL_BYTES:
            return os.strerror(errno.ENOSPC)
    return "an encoder that stopped" if isinstance(error, BrokenPipeError) else None


@contextmanager
def whole_file(path: Path) -> Iterator[Path]:
    """Yield a temporary sibling of `path` to write to; rename it to `path` on success, remove it on failure.

    The content is flushed before the rename, so that even a power cut never leaves a partial file at `path`. Raises
    CannotWrite if the disk rejects the file.
    """
    temporary = temporary_sibling(path)
    try:
        with writing(path):
            path.parent.mkdir(parents=True, exist_ok=True)
            temporary.touch()
            usual = temporary.stat().st_mode  # some libraries create files without group permissions
            temporary.unlink()
            yield temporary
            os.chmod(temporary, usual)
            _flush_file(temporary)
            _rename(temporary, path)
            _flush_entries(path.parent)
    finally:
        with suppress(PermissionError):  # Windows keeps a file that a failed writer left open
            temporary.unlink(missing_ok=True)


@contextmanager
def whole_folder(path: Path) -> Iterator[Path]:
    """Yield a temporary sibling folder of `path`; rename it to `path` on success, remove it on failure.

    Raises InputError if `path` is not empty or cannot be created, CannotWrite if the disk rejects a file.
    """
    reject_current_folder(path)
    reject_occupied(path)
    temporary = temporary_sibling(path.absolute())
    try:
        try:
            shutil.rmtree(temporary, ignore_errors=True)
            temporary.mkdir(parents=True)
        except OSError as error:
            got = error.strerror or str(error)
            raise input_error(path, "a path where a folder can be created", got, "Choose another path.") from error
        with writing(path):
            yield temporary
            complete_folder(temporary, path)
    finally:
        shutil.rmtree(temporary, ignore_errors=True)


@contextmanager
def removed_on_failure(folder: Path) -> Iterator[None]:
    """Remove a folder that the block creates and does not complete. One that there was keeps what was written."""
    existed = folder.exists()
    try:
        yield
    except BaseException:
        if not existed:
            shutil.rmtree(folder, ignore_errors=True)
        raise


def complete_folder(temporary: Path, path: Path) -> None:
    """Flush all files of a folder to the disk, then rename it to `path`; InputError if that is not empty."""
    reject_occupied(path)
    for place, _, files in os.walk(temporary):
        for name in files:
            _flush_file(Path(place, name))
        _flush_entries(Path(place))
    if path.is_dir():
        path.rmdir()  # Windows does not replace a folder
    _rename(temporary, path)
    _flush_entries(path.absolute().parent)


def _flush_file(path: Path) -> None:
    with open(path, "r+b") as file:  # Windows only flushes files that are open for writing
        os.fsync(file.fileno())


def _flush_entries(folder: Path) -> None:
    """Flush the names in a folder to the disk, where the system can do that."""
    try:
        number = os.open(folder, os.O_RDONLY)
        try:
            os.fsync(number)
        finally:
            os.close(number)
    except OSError as error:
        if error.errno not in NO_FOLDER_FLUSH:
            raise


def _rename(source: Path, target: Path) -> None:
    """Rename a file or folder; replaces a file."""
    for wait in RENAME_WAITS_S:
        try:
            os.replace(source, target)
            return
        except PermissionError as error:
            if not hasattr(error, "winerror"):
                raise
            clock.sleep(wait)
    os.replace(source, target)


def reject_current_folder(path: Path) -> None:
    """Raise InputError if `path` is the current folder or one of its parents, which cannot be replaced."""
    if lies_in(Path.cwd(), path):
        raise input_error(path, "the name of a new folder", "one that is in use", "Choose a new name in this folder.")


def reject_occupied(path: Path, alternative: str = "", *, ignore: Callable[[Path], bool] = lambda _: False) -> None:
    """Raise InputError, with `alternative` behind its fix, unless `path` is new or a folder of what to `ignore`."""
    try:
        if path.is_dir() and not all(map(ignore, path.iterdir())):
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


def write_text(path: Path, text: str) -> None:
    """Write `text` in UTF-8, atomically; the same bytes on every system, and none that a terminal obeys."""
    with whole_file(path) as temporary:
        temporary.write_text(printable(text), encoding="utf-8", newline="\n")


def write_json(path: Path, value: Any) -> None:
    """Write `value` as indented JSON, atomically; NaN is an error because it is not JSON."""
    write_text(path, json.dumps(value, indent=1, allow_nan=False) + "\n")


def read_json_object(path: Path) -> dict[str, Any] | None:
    """The object in a JSON file of our own that can be made again; None where there is none that can be read."""
    try:
        stored = json.loads(path.read_text(encoding="utf-8"))
    except (OSError, ValueError, RecursionError):
        return None
    return stored if isinstance(stored, dict) else None


def temporary_sibling(path: Path) -> Path:
    """The hidden path beside `path` that this process writes to: `.STEM.endoprior-MACHINE-PROCESS.partial.SUFFIX`.

    The suffix stays last: many writers choose the format by it.
    """
    return path.with_name(f".{path.stem}.endoprior-{_machine()}-{os.getpid()}.partial{path.suffix}")


def is_leftover(file: Path) -> bool:
    """Whether `file` is a temporary file or folder of a process that is known to have ended.

    That can only be known of processes that this one could see: of the same boot of this machine, in the same
    container. Links are never ours.
    """
    import psutil  # os.kill(process, 0), the usual test of POSIX, ends the process on Windows

    owner = re.fullmatch(rf"\..+\.endoprior-{_machine()}-([0-9]+)\.partial(\.[^.]+)?(\.staging)?", file.name)
    return bool(owner) and not file.is_symlink() and not psutil.pid_exists(int(owner[1]))


def remove_leftovers(folder: Path) -> None:
    """Remove what `is_leftover` in `folder`; what cannot be removed stays."""
    for file in filter(is_leftover, list(folder.iterdir())):
        if file.is_dir():
            shutil.rmtree(file, ignore_errors=True)
        else:
            with suppress(OSError):
                file.unlink()


@cache
def _machine() -> str:
    """12 hex digits of host, boot and PID namespace; where the system does not tell those, of this process alone."""
    try:
        known = Path("/proc/sys/kernel/random/boot_id").read_text("ascii") + os.readlink("/proc/self/ns/pid")
    except OSError:
        import psutil

        known = uuid.uuid4().hex if sys.platform == "linux" else str(round(psutil.boot_time() / 60))
    return hashlib.sha256(f"{socket.gethostname()} {known}".encode()).hexdigest()[:12]


def lies_in(path: Path, folder: Path) -> bool:
    """Whether `path` is `folder` or lies below it. Compares files, not names: macOS and Windows ignore case."""
    real = path.resolve()
    there = [above for above in (real, *real.parents) if os.path.exists(above)]
    return os.path.exists(folder) and any(os.path.samefile(above, folder) for above in there)
