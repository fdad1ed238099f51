"""Ctrl-C and termination signals that wait until an iteration is complete."""

from __future__ import annotations

import signal
import threading
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from typing import Any

from ..system.signals import stopping_signals


@contextmanager
def deferred_interrupt() -> Iterator[Callable[[], bool]]:
    """Hold back Ctrl-C and the signals of schedulers and closing terminals (SIGBREAK: of Windows).

    Yields a function that says whether to stop. A second Ctrl-C stops at once.
    """
    pressed = False

    def note(signum: int, frame: Any) -> None:
        nonlocal pressed
        if pressed and signum == signal.SIGINT:
            raise KeyboardInterrupt
        pressed = True

    if threading.current_thread() is not threading.main_thread():  # only the main one may handle signals
        yield lambda: False
        return
    previous = stopping_signals()
    try:
        for number in previous:
            signal.signal(number, note)
        yield lambda: pressed
    finally:
        for number, handler in previous.items():
            signal.signal(number, handler)
