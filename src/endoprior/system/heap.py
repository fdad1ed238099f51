"""Memory that training frees is kept for its next iteration instead of going back to the system.

Every iteration allocates the same large arrays. By default the GNU C library maps those above 32 MB anew each time, and
the system clears every page at its first use: half of the time of an iteration of `endosurf`, a fifth of `endogs`
(docs/log.md). Its setting for the limit does not go higher, so mapping is switched off.
"""

from __future__ import annotations

import ctypes
import sys

M_TRIM_THRESHOLD, M_MMAP_MAX = -1, -4
"""Names of the settings, from malloc.h."""
NEVER = -1
"""As a limit for trimming."""


def keep_freed_memory() -> None:
    """Keep what this process frees, for good; it ends with the process. Without effect where malloc is another one."""
    if sys.platform != "linux":
        return
    mallopt = getattr(ctypes.CDLL(None), "mallopt", None)
    if mallopt is not None:
        mallopt(M_MMAP_MAX, 0)
        mallopt(M_TRIM_THRESHOLD, NEVER)
