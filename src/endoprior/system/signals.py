"""Which signals ask this process to stop."""

from __future__ import annotations

import signal
from typing import Any

NAMES = ("SIGINT", "SIGTERM", "SIGHUP", "SIGBREAK")
"""Ctrl-C, schedulers, closing terminals, and Ctrl-Break of Windows."""


def stopping_signals() -> dict[int, Any]:
    """Signals to handle, each with its handler now, which is to be put back.

    One that is ignored stays so: `nohup` does that to SIGHUP on purpose. But scripts start jobs in the background with
    SIGINT ignored, and who sends it to such a job means it.
    """
    numbers = [getattr(signal, name) for name in NAMES if hasattr(signal, name)]
    handlers = {number: signal.getsignal(number) for number in numbers}
    return {
        number: handler
        for number, handler in handlers.items()
        if number == signal.SIGINT or handler is not signal.SIG_IGN
    }
