"""Numba kernels that use all threads, and what these threads do not survive: a fork, or two callers at once.

GNU OpenMP, Numba's usual threads on Linux, cannot be used after a fork of a process that has used them: Numba ends the
process, and whoever waits for its result waits forever. Numba's own threads ("workqueue") end the process when two
Python threads use them at once. docs/processes.md says what to write instead.
"""

from __future__ import annotations

import functools
import os
import sys
import threading
from collections.abc import Callable
from typing import Any, TypeVar

from numba import get_num_threads, njit
from numba.np.ufunc import threading_layer

Function = TypeVar("Function", bound=Callable[..., Any])


class _Threads:
    """What is known of Numba's threads in this process."""

    def __init__(self) -> None:
        self.lock = threading.Lock()
        self.take_one_caller = True  # also until Numba has chosen them
        self.are_lost = False  # they are those of the process that this one is a fork of

    def begun(self) -> None:
        """Note which ones Numba has started with the first kernel."""
        self.take_one_caller = _layer() == "workqueue"

    def forked(self) -> None:
        """In a fork the lock is free, and OpenMP has no threads if it had any before."""
        self.lock = threading.Lock()
        self.are_lost = self.are_lost or (_layer() == "omp" and sys.platform == "linux")


def _layer() -> str:
    """What Numba's threads are; empty before it has started any."""
    try:
        return threading_layer()
    except ValueError:
        return ""


_threads = _Threads()
if hasattr(os, "register_at_fork"):
    os.register_at_fork(after_in_child=_threads.forked)


def parallel_njit(**options: Any) -> Callable[[Function], Function]:
    """As `numba.njit` with `parallel` and `cache`, for a kernel that Python calls. It takes positional arguments."""

    def decorate(function: Function) -> Function:
        kernel = njit(parallel=True, cache=True, **options)(function)

        @functools.wraps(function)
        def guarded(*arguments: Any) -> Any:
            demand_unforked()
            if not _threads.take_one_caller:
                return kernel(*arguments)
            with _threads.lock:
                result = kernel(*arguments)
                _threads.begun()
            return result

        return guarded  # pyright: ignore[reportReturnType]

    return decorate


def start_threads() -> None:
    """Start Numba's threads now, not with the first kernel.

    Where they are those of OpenMP, which torch uses too, starting them sets its number of threads to
    `NUMBA_NUM_THREADS`; and torch rounds differently with another number. A training that starts them first gives the
    same bits whether the process has run kernels before or not.
    """
    demand_unforked()
    get_num_threads()


def demand_unforked() -> None:
    """Raise RuntimeError in a fork of a process whose threads do not survive it: here no kernel can run."""
    if not _threads.are_lost:
        return
    raise RuntimeError(
        "expected a process of its own, got a fork of one that has computed with OpenMP, whose threads it lacks. "
        'Fix: Start processes by `multiprocessing.get_context("spawn")`, and open the scene in each.'
    )
