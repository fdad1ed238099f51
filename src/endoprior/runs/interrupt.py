"""Ctrl-C and termination signals that wait until an iteration is complete."""

from __future__ import annotations

import signal
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from typing import Any

from ..system.signals import handled_by


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

    with handled_by(note):
        yield lambda: pressed
