"""Progress of countable steps: one updated line on a terminal, plain lines elsewhere."""

from __future__ import annotations

import sys
import time as clock

from ..core.text import printable
from ..runs.progress import PLAIN_EVERY_SECONDS
from ..system.console import say


class Counting:
    """Progress of countable steps: a line every few seconds, or one updated line on a terminal."""

    def __enter__(self) -> Counting:
        self._terminal, self._what, self._first, self._width = sys.stderr.isatty(), "", 0, 0
        self._began = self._last = clock.monotonic()
        return self

    def __exit__(self, *exc: object) -> None:
        if self._terminal and self._what:
            self._replace_line("")

    def __call__(self, what: str, done: int, total: int) -> None:
        """Report progress of the step `what`; a `total` of 0 is unknown."""
        now = clock.monotonic()
        if what != self._what:
            self._what, self._began, self._first = what, now, done
        elif not self._terminal and now - self._last < PLAIN_EVERY_SECONDS:
            return
        self._last = now
        rate = (done - self._first) / max(now - self._began, 1e-9)
        line = f"{what} {done}/{total or '?'}"
        if rate > 0 and total:
            line += f"  {rate:.1f}/s  {(total - done) / rate:.0f} s left"
        if self._terminal:
            self._replace_line(line)
        else:
            say(line)

    def _replace_line(self, line: str) -> None:
        """Overwrite the line of a terminal, without escape codes: older consoles of Windows print them."""
        line = printable(line)
        print(f"\r{line:<{self._width}}", end="\r", file=sys.stderr, flush=True)
        self._width = len(line)
