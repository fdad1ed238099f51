"""The file rules of Windows and macOS, imposed on this process, so that Linux can test what the code does under them.

Only calls from Python are covered; libraries in C that open files themselves keep the rules of Linux. Which files are
open or mapped comes from /proc, and so covers those libraries too.
"""

from __future__ import annotations

import builtins
import errno
import inspect
import io
import os
import re
import shutil
import stat
import sys
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import pytest

FORBIDDEN = re.compile(r'[<>:"|?*\\\x00-\x1f]|[. ]$|^(con|prn|aux|nul|com\d|lpt\d)(\.|$)', re.IGNORECASE)
"""Names that Windows does not accept."""
IN_USE, DENIED, EXISTS, BAD_NAME = 32, 5, 183, 123
"""Error numbers of Windows."""
ENCODING = "cp1252"
"""Of text files in western Europe and America, where none is given."""


def refusal(number: int, winerror: int, path: Any) -> OSError:
    """The error that Python raises on Windows: a POSIX number, and that of Windows."""
    error = OSError(number, os.strerror(number), os.fspath(path))
    error.winerror = winerror
    return error


def held_files() -> set[str]:
    """Files that this process holds open or mapped."""
    held = set()
    for link in Path("/proc/self/fd").iterdir():
        try:
            held.add(os.readlink(link))
        except OSError:  # closed meanwhile
            continue
    lines = Path("/proc/self/maps").read_text("utf-8").splitlines()
    return held | {line[line.index("/") :] for line in lines if "/" in line}


def reject_held(*paths: Any) -> None:
    """Reject to rename or remove what is open or mapped, and folders that hold such files."""
    held = held_files()
    for path in map(os.path.realpath, paths):
        if any((file == path or file.startswith(path + os.sep)) and not os.path.isdir(file) for file in held):
            raise refusal(errno.EACCES, IN_USE, path)


def existing_name(path: Any) -> Any:
    """The path with the names that exist already, if they differ in case only."""
    if not isinstance(path, str | os.PathLike) or not isinstance(os.fspath(path), str):
        return path
    text = os.fspath(path)
    place = "/" if text.startswith("/") else ""
    for name in filter(None, text.split("/")):
        here = os.path.join(place, name)
        if not os.path.lexists(here) and os.path.isdir(place or "."):
            name = next((other for other in os.listdir(place or ".") if other.lower() == name.lower()), name)
        place = os.path.join(place, name)
    return place or text


def reject_names(path: Any) -> None:
    """Reject names that Windows does not accept."""
    if isinstance(path, str | os.PathLike) and isinstance(os.fspath(path), str):
        if any(FORBIDDEN.search(name) for name in Path(path).parts if name not in ("/", "..")):
            raise refusal(errno.EINVAL, BAD_NAME, path)


@contextmanager
def case_is_ignored() -> Iterator[None]:
    """macOS and Windows: a name finds the file whose name differs in case only."""
    with pytest.MonkeyPatch.context() as patch:
        if sys.platform == "linux":  # elsewhere it is so
            _ignore_case(patch)
        yield


@contextmanager
def windows_files() -> Iterator[None]:
    """Windows: open files stay, folders are not opened or replaced, text is not UTF-8, some names are taken."""
    with case_is_ignored(), pytest.MonkeyPatch.context() as patch:  # undone the other way round
        if sys.platform == "linux":
            _impose_windows(patch)
        elif os.name != "nt":
            pytest.skip("needs /proc or Windows")
        yield


def _ignore_case(patch: pytest.MonkeyPatch) -> None:
    real = {name: getattr(os, name) for name in ("stat", "lstat", "open", "mkdir", "unlink", "remove", "rmdir")}
    found = {"on": True}

    def folded(function: Callable) -> Callable:
        def call(path: Any, *rest: Any, **options: Any) -> Any:
            if not found["on"]:  # `existing_name` looks for files itself
                return function(path, *rest, **options)
            found["on"] = False
            try:
                path = existing_name(path)
            finally:
                found["on"] = True
            return function(path, *rest, **options)

        return call

    for name, function in real.items():
        patch.setattr(os, name, folded(function))
    for module in (builtins, io):
        patch.setattr(module, "open", folded(module.open))


def _impose_windows(patch: pytest.MonkeyPatch) -> None:
    os_open, fsync, replace, rename = os.open, os.fsync, os.replace, os.rename
    unlink, rmdir, mkdir, kill, plain_open = os.unlink, os.rmdir, os.mkdir, os.kill, io.open

    def open_number(path: Any, flags: int, mode: int = 0o777, **options: Any) -> int:
        if os.path.isdir(path) and flags & os.O_TMPFILE != os.O_TMPFILE:  # used by `tempfile` on Linux only
            raise refusal(errno.EACCES, DENIED, path)
        reject_names(path)
        return os_open(path, flags, mode, **options)

    def open_file(
        file: Any, mode: str = "r", buffering: int = -1, encoding=None, errors=None, newline=None, **rest: Any
    ):
        if not isinstance(file, int):
            reject_names(file)
        if "b" not in mode:
            encoding = ENCODING if encoding in (None, "locale") else encoding
            newline = "\r\n" if newline is None and not mode.startswith("r") else newline
        return plain_open(file, mode, buffering, encoding, errors, newline, **rest)

    def flush(number: int) -> None:
        import fcntl

        if fcntl.fcntl(number, fcntl.F_GETFL) & os.O_ACCMODE == os.O_RDONLY:
            raise OSError(errno.EBADF, os.strerror(errno.EBADF))
        fsync(number)

    def move(source: Any, target: Any, *, keeps: bool = False, **options: Any) -> None:
        reject_names(target)
        if os.path.isdir(target):
            raise refusal(errno.EACCES, DENIED, target)
        if keeps and os.path.lexists(target):
            raise refusal(errno.EEXIST, EXISTS, target)
        reject_held(source, target)
        (rename if keeps else replace)(source, target, **options)

    def remove(path: Any, **options: Any) -> None:
        reject_held(path)
        unlink(path, **options)

    def remove_tree(path: Any, ignore_errors: bool = False) -> None:
        """As `shutil.rmtree`, which on Linux works on open folders."""
        try:
            for entry in os.scandir(path):
                if stat.S_ISDIR(os.lstat(entry.path).st_mode):
                    remove_tree(entry.path, ignore_errors)
                else:
                    remove(entry.path)
            rmdir(path)
        except OSError:
            if not ignore_errors:
                raise

    def make_folder(path: Any, *rest: Any, **options: Any) -> None:
        reject_names(path)
        mkdir(path, *rest, **options)

    def end_process(number: int, signal: int) -> None:
        if not inspect.currentframe().f_back.f_globals["__name__"].startswith("psutil"):  # asks in another way there
            raise AssertionError("os.kill ends a process on Windows, whatever the signal")
        kill(number, signal)

    changes = {"open": open_number, "fsync": flush, "replace": move, "kill": end_process, "mkdir": make_folder}
    changes |= {
        "rename": lambda *paths, **options: move(*paths, keeps=True, **options),
        "unlink": remove,
        "remove": remove,
    }
    for name, function in changes.items():
        patch.setattr(os, name, function)
    for name in ("sched_getaffinity", "killpg", "mkfifo", "fork"):  # not there
        patch.delattr(os, name)
    patch.setattr(shutil, "rmtree", remove_tree)
    for module in (builtins, io):
        patch.setattr(module, "open", open_file)
