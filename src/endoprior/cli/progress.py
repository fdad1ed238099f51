"""Progress: one line that is replaced on a terminal, lines now and then elsewhere."""

from __future__ import annotations

import sys
import time as clock
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager, suppress
from typing import Self

from ..core.checks import printable
from ..runs.progress import PLAIN_EVERY_SECONDS
from ..system.console import say

UPDATE_SECONDS = 0.2
"""Time between two updates of the line on a terminal."""


LeftOfAll = Callable[[str, int, int], float]
"""Takes what is being done, how much of it, and of how much; gives the time that is left of the whole command, s."""


class Counting:
    """Shows what is being done, how much of it is done, and the time that is left."""

    def __init__(self, head: str = "", left_of_all: LeftOfAll | None = None) -> None:
        """Args: head: stands in front of each line. left_of_all: None: time left is that of the part, at its rate."""
        self._head, self._what, self._width, self._terminal = head, "", 0, sys.stderr.isatty()
        self._left_of_all = left_of_all

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *exc: object) -> None:
        if self._width:
            self._replace_line("")

    def __call__(self, what: str, done: int, total: int) -> None:
        """Report progress of the part `what`; a `total` of 0 is unknown."""
        now = clock.monotonic()
        left = self._left_of_all(what, done, total) if self._left_of_all else None
        if what != self._what:
            self._what, self._began, self._first = what, now, done
        elif now - self._last < (UPDATE_SECONDS if self._terminal else PLAIN_EVERY_SECONDS):
            return
        self._last = now
        line = f"{self._head}{what}{f' {done}/{total}' if total else f' {done}' if done else ''}"
        if total and done > self._first:
            seconds = (now - self._began) / (done - self._first)
            line += f"  {1 / max(seconds, 1e-9):.1f}/s"
            line += f"  {duration((total - done) * seconds)} left" if left is None else ""
        line += "" if left is None else f"  {duration(left)} to the end"
        (self._replace_line if self._terminal else say)(line)

    def _replace_line(self, line: str) -> None:
        """Overwrite the line of a terminal, without escape codes: older consoles of Windows print them."""
        line = printable(line)
        with suppress(OSError):  # the terminal was closed, and the work goes on
            print(f"\r{line:<{self._width}}", end="\r", file=sys.stderr, flush=True)
        self._width = len(line)


@contextmanager
def step_progress(names: Sequence[str], name: str, left_of_all: LeftOfAll | None = None) -> Iterator[Counting]:
    """Show the progress of one of several steps, then how long it took."""
    head, began = step_head(names, name), clock.monotonic()
    with Counting(f"{head}: ", left_of_all) as progress:
        yield progress
    say(f"{head:<13} {duration(clock.monotonic() - began)}")


def step_head(names: Sequence[str], name: str) -> str:
    """What stands in front of the lines of a step: `3/6  train`."""
    return f"{names.index(name) + 1}/{len(names)}  {name}"


def duration(seconds: float) -> str:
    """Seconds as text: `42 s`, `3 min 20 s`, `1 h 5 min`."""
    whole = round(seconds)
    if whole < 100:
        return f"{whole} s"
    minutes, rest = divmod(whole, 60)
    if minutes < 60:
        return f"{minutes} min {rest} s" if rest else f"{minutes} min"
    return f"{minutes // 60} h {minutes % 60} min"
