"""Names of temporary files, and the removal of those that killed processes left. A name says whose file it is."""

from __future__ import annotations

import hashlib
import os
import re
import shutil
import socket
import sys
import uuid
from contextlib import suppress
from functools import cache
from pathlib import Path


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

    owner = re.fullmatch(rf"\..+\.endoprior-{_machine()}-([0-9]+)\.partial(\.[^.]+)?", file.name)
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
        known = uuid.uuid4().hex if sys.platform == "linux" else _minute_of_boot()
    return hashlib.sha256(f"{socket.gethostname()} {known}".encode()).hexdigest()[:12]


def _minute_of_boot() -> str:
    import psutil

    return str(round(psutil.boot_time() / 60))
