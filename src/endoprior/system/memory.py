"""How much memory there is, and a cache that takes its share of it and no more."""

from __future__ import annotations

import os
import threading
from collections import OrderedDict
from collections.abc import Callable, Hashable
from pathlib import Path
from typing import Generic, TypeVar

from ..core.checks import InputError

CACHE_SHARE = 0.1
"""Each cache of frames may take this share of what is free when it is made..."""
LEAST_CACHE = 256 * 2**20
"""... but at least so many bytes."""
LEAST_DATA, LEAST_SPACE = 600 * 2**20, 1500 * 2**20
"""Of memory to write to and of addresses, for the libraries alone, bytes (docs/reliability.md)."""
VARIABLE = "ENDOPRIOR_CACHE_GB"
"""Environment variable that sets the size of each cache instead, GB."""

Value = TypeVar("Value")


def available_bytes() -> int | None:
    """Memory that this process can still take, by the system, its container and its own limit; None if unknown."""
    found = [_free_in_system(), _left_in_container(), _left_of_limit()]
    known = [value for value in found if value is not None]
    return max(min(known), 0) if known else None


def cache_bytes() -> int:
    """Size of one cache of frames: `ENDOPRIOR_CACHE_GB`, or a share of what is free. No result depends on it."""
    try:
        return max(int(float(os.environ[VARIABLE]) * 1e9), 0)
    except (KeyError, ValueError, OverflowError):
        return max(int(CACHE_SHARE * (available_bytes() or 0)), LEAST_CACHE)


def reject_small_limits() -> None:
    """Refuse limits of the process under which not even the libraries load: some of them wait for memory for ever.

    Raises:
        InputError: with the limit and what it should be.
    """
    try:
        import resource
    except ImportError:  # a system without such limits
        return
    for kind, option, least in ((resource.RLIMIT_DATA, "-d", LEAST_DATA), (resource.RLIMIT_AS, "-v", LEAST_SPACE)):
        limit = resource.getrlimit(kind)[0]
        if limit != resource.RLIM_INFINITY and limit < least:
            raise InputError(
                f"ulimit {option}: expected at least {least >> 20} MB to load the libraries; got {limit >> 20} MB. "
                "Raise it."
            )


class BoundedCache(Generic[Value]):
    """Values by key; beyond a number of bytes, those that were not used for longest go. Threads may share one."""

    def __init__(self, limit_bytes: int, size_of: Callable[[Value], int]) -> None:
        """Start empty.

        Args:
            limit_bytes: kept in all; the newest value stays whatever its size.
            size_of: bytes of a value.
        """
        self._limit, self._size_of = limit_bytes, size_of
        self._values: OrderedDict[Hashable, Value] = OrderedDict()
        self._bytes = 0
        self._lock = threading.Lock()

    def __len__(self) -> int:
        return len(self._values)

    def get(self, key: Hashable, make: Callable[[], Value]) -> Value:
        """The value of `key`, made now if it is not there. Two threads may make the same one twice."""
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


def _free_in_system() -> int | None:
    try:
        lines = Path("/proc/meminfo").read_text().splitlines()
        return next(int(line.split()[1]) * 1024 for line in lines if line.startswith("MemAvailable:"))
    except (OSError, StopIteration, ValueError):
        pass
    try:
        return os.sysconf("SC_PHYS_PAGES") * os.sysconf("SC_PAGE_SIZE") // 2
    except (AttributeError, OSError, ValueError):
        return None


def _left_in_container() -> int | None:
    for limit, used in (
        ("/sys/fs/cgroup/memory.max", "/sys/fs/cgroup/memory.current"),
        ("/sys/fs/cgroup/memory/memory.limit_in_bytes", "/sys/fs/cgroup/memory/memory.usage_in_bytes"),
    ):
        try:
            return int(Path(limit).read_text()) - int(Path(used).read_text())
        except (OSError, ValueError):  # no such group, or no limit
            continue
    return None


def _left_of_limit() -> int | None:
    """Of the limits on what the process may map (`ulimit -v`) and write to (`ulimit -d`)."""
    try:
        import resource

        lines = (line.split() for line in Path("/proc/self/status").read_text().splitlines())
        used = {words[0]: int(words[1]) * 1024 for words in lines if words and words[0] in ("VmSize:", "VmData:")}
        limits = {"VmSize:": resource.RLIMIT_AS, "VmData:": resource.RLIMIT_DATA}
        soft = {name: resource.getrlimit(kind)[0] for name, kind in limits.items()}
    except (ImportError, OSError, ValueError):
        return None
    left = [limit - used[name] for name, limit in soft.items() if limit != resource.RLIM_INFINITY and name in used]
    return min(left, default=None)


def workers(bytes_each: int) -> int:
    """Threads that may work side by side when each needs so many bytes: one per core, in a quarter of what is free."""
    free = available_bytes()
    affordable = free // 4 // max(bytes_each, 1) if free is not None else 1
    return max(1, min(os.cpu_count() or 1, affordable))
