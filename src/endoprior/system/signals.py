"""Signals that ask this process to stop: Ctrl-C, and those of schedulers and closing terminals."""

from __future__ import annotations

import signal
import threading
import time as clock
from collections.abc import Callable, Iterator
from contextlib import AbstractContextManager, contextmanager
from typing import Any

NAMES = ("SIGINT", "SIGTERM", "SIGHUP", "SIGBREAK")
"""Ctrl-C, schedulers, closing terminals, and Ctrl-Break of Windows."""
REPEAT_S = 5.0
"""A closing terminal sends SIGHUP twice, and schedulers repeat SIGTERM: what comes within this time is the same one."""


@contextmanager
def handled_by(handler: Callable[[int, Any], None]) -> Iterator[None]:
    """Call `handler` on each of these signals; nothing changes outside the main thread, which alone may handle them.

    One that is ignored stays so: `nohup` does that to SIGHUP on purpose. But scripts start jobs in the background with
    SIGINT ignored, and who sends it to such a job means it. One that the program around Python handles (R, Blender)
    stays so, too: Python could not give it back.
    """
    if threading.current_thread() is not threading.main_thread():
        yield
        return
    numbers = [getattr(signal, name) for name in NAMES if hasattr(signal, name)]
    before = {number: found for number in numbers if (found := signal.getsignal(number)) is not None}
    heard = [number for number in before if number == signal.SIGINT or before[number] is not signal.SIG_IGN]
    try:
        for number in heard:
            signal.signal(number, handler)
        yield
    finally:
        for number in heard:
            signal.signal(number, before[number])


@contextmanager
def held_back() -> Iterator[None]:
    """Let these signals wait until the block, which must be short, is done."""
    heard = list[int]()
    try:
        with handled_by(lambda number, _frame: heard.append(number)):
            yield
    finally:
        for number in heard[:1]:
            signal.raise_signal(number)


def all_interrupt() -> AbstractContextManager[None]:
    """Let each of these signals raise KeyboardInterrupt, so that what is cleaned up after Ctrl-C always is."""
    last = -REPEAT_S

    def interrupt(signum: int, _frame: Any) -> None:
        nonlocal last
        before, last = last, clock.monotonic()
        if signum == signal.SIGINT or last - before >= REPEAT_S:
            raise KeyboardInterrupt

    return handled_by(interrupt)
