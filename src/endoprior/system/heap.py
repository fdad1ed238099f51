"""Memory that training frees is kept for its next iteration instead of going back to the system.

Every iteration allocates the same large arrays. By default the GNU C library maps those above 32 MB anew each time, and
the system clears every page at its first use: up to half of the time of an iteration of `endosurf`, a quarter of
`endogs` (docs/log.md). Its setting for the limit does not go higher, so mapping is switched off.
"""

from __future__ import annotations

import ctypes
import sys
from collections.abc import Iterator
from contextlib import contextmanager

M_TRIM_THRESHOLD, M_MMAP_THRESHOLD, M_MMAP_MAX = -1, -3, -4
"""Names of the settings, from malloc.h."""
KEPT = {M_MMAP_MAX: 0, M_TRIM_THRESHOLD: -1}
"""Nothing is mapped on its own, nothing goes back."""
USUAL = {M_MMAP_MAX: 65_536, M_MMAP_THRESHOLD: 2**25, M_TRIM_THRESHOLD: 2**26}
"""What the library arrives at by itself in a process that frees large arrays."""


@contextmanager
def freed_memory_kept() -> Iterator[None]:
    """Inside, this process keeps what it frees; at the end that goes back. Without effect where malloc is another."""
    library = _library()
    if library is None:
        yield
        return
    _set(library, KEPT)
    try:
        yield
    finally:
        _set(library, USUAL)
        library.malloc_trim(0)


def _library() -> ctypes.CDLL | None:
    """The C library, if it has these settings."""
    library = ctypes.CDLL(None) if sys.platform == "linux" else None
    return library if hasattr(library, "mallopt") and hasattr(library, "malloc_trim") else None


def _set(library: ctypes.CDLL, settings: dict[int, int]) -> None:
    for name, value in settings.items():
        library.mallopt(name, value)
