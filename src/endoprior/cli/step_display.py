"""Progress of a job of several steps: one line that is updated on a terminal, plain lines elsewhere."""

from __future__ import annotations

import sys
import time as clock
from collections.abc import Callable, Iterator
from contextlib import contextmanager

from ..core.text import printable
from ..runs.progress import PLAIN_EVERY_SECONDS
from ..system.console import say

UPDATE_SECONDS = 0.2
"""Time between two updates of the line on a terminal."""


class StepDisplay:
    """Shows the step, how far it is, and the time that is left if it was estimated."""

    def __init__(self, names: list[str], seconds: dict[str, float]) -> None:
        """Args: names: of all steps, in order. seconds: estimate of each step; empty if there is none."""
        self._names, self._seconds, self._terminal = names, seconds, sys.stderr.isatty()

    @contextmanager
    def step(self, name: str) -> Iterator[Callable[[str, int, int], None]]:
        """Yield the progress callback of a step: (what is being done, how much is done, how much there is)."""
        head, began = self._head(name), clock.monotonic()
        shown_at = began

        def progress(what: str, done: int, total: int) -> None:
            nonlocal shown_at
            now = clock.monotonic()
            if now - shown_at < (UPDATE_SECONDS if self._terminal else PLAIN_EVERY_SECONDS):
                return
            shown_at = now
            line = f"{head}: {what}{f' {done}/{total}' if total else ''}{self._left(name, now - began)}"
            if self._terminal:
                print(f"\r\x1b[K{printable(line)}", end="", file=sys.stderr, flush=True)
            else:
                say(line)

        try:
            yield progress
        finally:
            if self._terminal:
                print("\r\x1b[K", end="", file=sys.stderr, flush=True)
        say(f"{head:<13} {duration(clock.monotonic() - began)}")

    def skip(self, name: str) -> None:
        """Say that a step was done before."""
        say(f"{self._head(name):<13} done before")

    def _head(self, name: str) -> str:
        return f"{self._names.index(name) + 1}/{len(self._names)}  {name}"

    def _left(self, name: str, elapsed: float) -> str:
        """The time that is left of all steps, as text; empty without an estimate."""
        if not self._seconds:
            return ""
        later = self._names[self._names.index(name) + 1 :]
        left = max(self._seconds[name] - elapsed, 0.0) + sum(self._seconds[other] for other in later)
        return f"  about {duration(left)} left"


def duration(seconds: float) -> str:
    """Seconds as text: `42 s`, `3 min 20 s`, `1 h 5 min`."""
    whole = round(seconds)
    if whole < 100:
        return f"{whole} s"
    minutes, rest = divmod(whole, 60)
    if minutes < 60:
        return f"{minutes} min {rest} s" if rest else f"{minutes} min"
    return f"{minutes // 60} h {minutes % 60} min"
