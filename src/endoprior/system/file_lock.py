"""A lock file that one process holds."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager, suppress
from pathlib import Path

from filelock import FileLock, Timeout

from ..core.checks import input_error


@contextmanager
def locked(folder: Path, file: Path) -> Iterator[None]:
    """Hold the lock `file`, so that no second process writes `folder`; the lock of a killed process is free.

    Raises:
        InputError: another process has the lock, or it cannot be created.
    """
    lock = FileLock(file)
    try:
        lock.acquire(blocking=False)
    except Timeout:
        fix = "Wait for it, or choose another folder."
        raise input_error(folder, "a folder that no other process is writing", "one that is in use", fix) from None
    except OSError as error:
        got = error.strerror or str(error)
        raise input_error(folder, "a path where a folder can be created", got, "Choose another path.") from None
    try:
        yield
    finally:
        with suppress(PermissionError):  # Windows does not remove an open file; there the library does it
            file.unlink(missing_ok=True)
        lock.release()
