"""Progress of long operations: a bar with rate and remaining time on a terminal, plain lines elsewhere."""

from __future__ import annotations

import sys
import time as clock
from collections.abc import Iterator
from contextlib import contextmanager
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from ..training.state import StepReport
    from ..training.trainer import Trainer

PLAIN_EVERY_SECONDS = 10.0


def say(text: str) -> None:
    """Print one line and flush it."""
    print(text, flush=True)


@contextmanager
def training_progress() -> Iterator:
    """Yield the `on_step` callback of `runs.training_run.train`."""
    if sys.stderr.isatty():
        with _bar() as callback:
            yield callback
    else:
        yield _PlainLines()


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
        print(f"\r{line:<{self._width}}", end="\r", file=sys.stderr, flush=True)
        self._width = len(line)


class _PlainLines:
    """Prints a line every few seconds, for log files."""

    def __init__(self) -> None:
        self.began = clock.monotonic()
        self.last = self.began
        self.done_before: int | None = None

    def __call__(self, report: StepReport, trainer: Trainer) -> None:
        done, total = trainer.progress()
        if self.done_before is None:
            self.done_before = done - 1
        now = clock.monotonic()
        if now - self.last < PLAIN_EVERY_SECONDS and done < total:
            return
        self.last = now
        rate = (done - self.done_before) / max(now - self.began, 1e-9)
        left = (total - done) / max(rate, 1e-9)
        say(
            f"{report.stage.name.lower()} {done}/{total}  {rate:.1f} it/s  {left:.0f} s left  "
            f"color {report.terms['color']:.4f}  {report.num_gaussians} Gaussians"
        )


@contextmanager
def _bar() -> Iterator:
    from rich.console import Console
    from rich.progress import BarColumn, MofNCompleteColumn, Progress, TextColumn, TimeRemainingColumn

    columns = (
        TextColumn("{task.description}"),
        BarColumn(),
        MofNCompleteColumn(),
        TextColumn("{task.fields[rate]}"),
        TimeRemainingColumn(),
        TextColumn("{task.fields[facts]}"),
    )
    with Progress(*columns, console=Console(stderr=True)) as progress:
        task = progress.add_task("starting", total=None, rate="", facts="")

        def callback(report: StepReport, trainer: Trainer) -> None:
            done, total = trainer.progress()
            progress.update(
                task,
                completed=done,
                total=total,
                description=report.stage.name.lower(),
                rate=f"{1 / max(report.seconds, 1e-9):.0f} it/s",
                facts=f"color {report.terms['color']:.4f}  {report.num_gaussians} Gaussians",
            )

        yield callback
