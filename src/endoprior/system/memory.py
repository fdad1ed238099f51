"""Memory: what is left, caches of bounded size, and what training frees."""

from __future__ import annotations

import ctypes
import os
import sys
import threading
from collections import OrderedDict
from collections.abc import Callable, Hashable, Iterator
from contextlib import contextmanager, suppress
from pathlib import Path
from typing import Generic, TypeVar

from ..core.checks import input_error
from .devices import num_cores

CACHE_SHARE = 0.1
MIN_CACHE, MAX_CACHE = 256 * 2**20, 512 * 2**20
"""Size of each frame cache: a share of the free memory at its creation, but at least and at most so many bytes. So a
window of a long sequence fits, and memory does not grow."""
MIN_DATA, MIN_SPACE = 600 * 2**20, 1500 * 2**20
"""Writable memory and address space that the libraries alone need, bytes (docs/reliability.md)."""
VARIABLE = "ENDOPRIOR_CACHE_GB"
"""Environment variable that overrides the size of each cache, GB."""
M_TRIM_THRESHOLD, M_MMAP_THRESHOLD, M_MMAP_MAX = -1, -3, -4
"""Names of the settings, from malloc.h."""
KEPT = {M_MMAP_MAX: 0, M_TRIM_THRESHOLD: -1}
"""Nothing is mapped on its own, nothing goes back."""
USUAL = {M_MMAP_MAX: 65_536, M_MMAP_THRESHOLD: 2**25, M_TRIM_THRESHOLD: 2**26}
"""What the library arrives at by itself in a process that frees large arrays."""

CONTROL_GROUP = Path("/sys/fs/cgroup")
"""Where Linux tells the limits of a container."""
GROUP_FILES = (
    ("memory.max", "memory.current", "memory.stat", "inactive_file"),
    ("memory/memory.limit_in_bytes", "memory/memory.usage_in_bytes", "memory/memory.stat", "total_inactive_file"),
)
"""Of versions 2 and 1: the files with limit, use and its parts, and the part that Linux frees when it is needed."""

Value = TypeVar("Value")


def available_bytes() -> int | None:
    """Memory that this process can still allocate: limits of system, container and process; None if unknown."""
    import psutil

    left = [*_left_in_container(), *_left_of_limits()]
    with suppress(OSError, ValueError, psutil.Error):  # Linux without /proc
        left.append(psutil.virtual_memory().available)
    return max(min(left), 0) if left else None


def cache_bytes() -> int:
    """Size of one frame cache: `ENDOPRIOR_CACHE_GB`, or a share of the free memory. It does not change any result."""
    try:
        return max(int(float(os.environ[VARIABLE]) * 1e9), 0)
    except (KeyError, ValueError, OverflowError):
        return min(max(int(CACHE_SHARE * (available_bytes() or 0)), MIN_CACHE), MAX_CACHE)


def reject_small_limits() -> None:
    """Raise InputError for process limits that are too small to load the libraries; some of them would hang."""
    try:
        import resource
    except ImportError:  # the system has no such limits
        return
    for kind, option, least in ((resource.RLIMIT_DATA, "-d", MIN_DATA), (resource.RLIMIT_AS, "-v", MIN_SPACE)):
        limit = resource.getrlimit(kind)[0]
        if limit != resource.RLIM_INFINITY and limit < least:
            want, got = f"at least {least >> 20} MB to load the libraries", f"{limit >> 20} MB"
            raise input_error(f"ulimit {option}", want, got, f"`ulimit {option} {least >> 10}` or more.")


class BoundedCache(Generic[Value]):
    """A least-recently-used cache of bounded size in bytes. Thread-safe."""

    def __init__(self, limit_bytes: int, size_of: Callable[[Value], int]) -> None:
        """Args: limit_bytes: total size; the newest value always stays. size_of: the size of a value in bytes."""
        self._limit, self._size_of = limit_bytes, size_of
        self._values: OrderedDict[Hashable, Value] = OrderedDict()
        self._bytes = 0
        self._lock = threading.Lock()

    def __len__(self) -> int:
        return len(self._values)

    def get(self, key: Hashable, make: Callable[[], Value]) -> Value:
        """The value of `key`, created by `make` if it is missing. Two threads may create the same value twice."""
        with self._lock:
            if key in self._values:
                self._values.move_to_end(key)
                return self._values[key]
        value = make()
        with self._lock:
            if key not in self._values:
                self._values[key] = value
                self._bytes += self._size_of(value)
            while self._bytes > self._limit and len(self._values) > 1:
                _, oldest = self._values.popitem(last=False)
                self._bytes -= self._size_of(oldest)
            return self._values.get(key, value)


def _left_in_container() -> Iterator[int]:
    """Memory below the limit of a container, bytes. The system frees cached files when it needs memory: they count."""
    for limit, used, parts, cached in GROUP_FILES:
        with suppress(OSError, ValueError):  # no such group, or no limit
            left = int((CONTROL_GROUP / limit).read_text("ascii")) - int((CONTROL_GROUP / used).read_text("ascii"))
            with suppress(OSError, ValueError):  # the limit holds without its parts, too
                sizes = dict(line.split() for line in (CONTROL_GROUP / parts).read_text("ascii").splitlines())
                left += int(sizes.get(cached, 0))
            yield left


def _left_of_limits() -> Iterator[int]:
    """Rest of the limits on address space (`ulimit -v`) and writable memory (`ulimit -d`)."""
    with suppress(ImportError, OSError, ValueError):
        import resource

        lines = (line.split() for line in Path("/proc/self/status").read_text("utf-8").splitlines())
        used = {words[0]: int(words[1]) * 1024 for words in lines if words and words[0] in ("VmSize:", "VmData:")}
        for name, kind in (("VmSize:", resource.RLIMIT_AS), ("VmData:", resource.RLIMIT_DATA)):
            limit = resource.getrlimit(kind)[0]
            if limit != resource.RLIM_INFINITY and name in used:
                yield limit - used[name]


def workers(bytes_each: int) -> int:
    """Number of parallel threads that need `bytes_each`: at most one per core, and a quarter of the free memory."""
    free = available_bytes()
    affordable = free // 4 // max(bytes_each, 1) if free is not None else 1
    return max(1, min(num_cores(), affordable))


@contextmanager
def freed_memory_kept() -> Iterator[None]:
    """Inside, this process keeps what it frees; at the end that goes back. Without effect where malloc is another.

    Every iteration of a training allocates the same large arrays. By default the GNU C library maps those above 32 MB
    anew each time, and the system clears every page at its first use: a quarter to half of the time of an iteration of
    radiance fields (docs/log.md). Its setting for the limit does not go higher, so mapping is switched off.
    """
    library = ctypes.CDLL(None) if sys.platform == "linux" else None
    if library is None or not (hasattr(library, "mallopt") and hasattr(library, "malloc_trim")):
        yield
        return
    for setting in KEPT.items():
        library.mallopt(*setting)
    try:
        yield
    finally:
        for setting in USUAL.items():
            library.mallopt(*setting)
        library.malloc_trim(0)
