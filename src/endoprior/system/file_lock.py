"""A lock file that one process holds."""

from __future__ import annotations

import errno
from collections.abc import Iterator
from contextlib import ExitStack, contextmanager, suppress
from pathlib import Path

from filelock import FileLock, SoftFileLock, Timeout

from ..core.checks import input_error

NO_FLOCK = {errno.ENOSYS, errno.ENOTSUP, errno.EOPNOTSUPP, errno.ENOLCK, errno.EINVAL}
"""Answers of network drives that have no locks, or whose lock service does not run."""
SOFT_SECONDS = 0.5
"""Least time to find out that the owner of a lock without `flock` has ended, and to take its place."""


@contextmanager
def exclusive(file: Path, seconds: float = 0.0) -> Iterator[None]:
    """Hold the lock `file`; that of a killed process is free.

    On a drive without locks the file itself is the lock, and names its owner. There that of a killed process is free
    only if it ran on the same machine, since its last start, and in the same container: of others it is not known.

    Args:
        seconds: how long to wait for it; then `filelock.Timeout`.
    """
    lock, existed = FileLock(file, fallback_to_soft=False), file.exists()
    try:
        lock.acquire(seconds)
    except OSError as error:
        if error.errno not in NO_FLOCK:
            raise
        if not existed and not file.stat().st_size:  # the attempt made it
            file.unlink(missing_ok=True)
        lock = SoftFileLock(file)
        lock.acquire(max(seconds, SOFT_SECONDS))
    try:
        yield
    finally:
        if not isinstance(lock, SoftFileLock):
            with suppress(PermissionError):  # Windows does not remove an open file; there the library does it
                file.unlink(missing_ok=True)
        lock.release()


@contextmanager
def locked(folder: Path, file: Path) -> Iterator[None]:
    """Hold the lock `file`, so that no second process writes `folder`; InputError if that is not possible."""
    with ExitStack() as stack:
        try:
            stack.enter_context(exclusive(file))
        except Timeout:
            names_owner = file.exists() and file.stat().st_size
            by_file = f"; if it has ended, on whatever machine, remove {file}" if names_owner else ""
            fix = f"Wait for it, or choose another folder{by_file}."
            raise input_error(folder, "a folder that no other process is writing", "one that is in use", fix) from None
        except OSError as error:
            got = error.strerror or str(error)
            raise input_error(folder, "a folder that can be written", got, "Choose another path.") from None
        yield
