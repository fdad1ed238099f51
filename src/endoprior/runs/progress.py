"""Progress of a training: a bar on a terminal, one updated line in a notebook, plain lines elsewhere."""

from __future__ import annotations

import sys
import time as clock
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from typing import TYPE_CHECKING

from ..system.console import say

if TYPE_CHECKING:
    from ..training.trainer import Observer, StepReport, Trainer

PLAIN_EVERY_SECONDS = 10.0  # time between two lines in a log file
NOTEBOOK_EVERY_SECONDS = 0.5


def is_watched() -> bool:
    """Whether stderr is a terminal, or this is a notebook."""
    return sys.stderr.isatty() or _in_notebook()


@contextmanager
def training_progress() -> Iterator[Observer]:
    """Yield an observer that shows the progress of a training."""
    if sys.stderr.isatty():
        with _bar() as observer:
            yield observer
    elif _in_notebook():
        try:
            yield _lines(NOTEBOOK_EVERY_SECONDS, _say_in_place)
        finally:  # also after "Interrupt": what comes next begins on a line of its own
            print(file=sys.stderr)
    else:
        yield _lines(PLAIN_EVERY_SECONDS, say)


def _in_notebook() -> bool:
    from rich.console import Console

    return Console().is_jupyter


def _say_in_place(line: str) -> None:
    """Replace the last line. Rich would need ipywidgets to do that in a notebook."""
    print(f"\r{line:<79}", end="", file=sys.stderr, flush=True)


def _lines(every_seconds: float, show: Callable[[str], None]) -> Observer:
    """Passes a line to `show` every few seconds."""
    began = last = clock.monotonic()
    seen = before = 0

    def observer(report: StepReport, trainer: Trainer) -> None:
        nonlocal began, last, seen, before
        (done, total), now = trainer.progress(), clock.monotonic()
        if seen == 0 or done <= seen:  # the first iteration, or that of the next window
            began, before = now - report.seconds, done - 1
        seen = done
        if now - last >= every_seconds or done >= total:
            last, rate = now, max((done - before) / max(now - began, 1e-9), 1e-9)
            left = (total - done) / rate
            show(f"{report.stage.name.lower()} {done}/{total}  {rate:.1f} it/s  {left:.0f} s left  {_facts(report)}")

    return observer


def _facts(report: StepReport) -> str:
    """The loss of the color, and how many Gaussians there are; a radiance field has none."""
    count = f"  {report.num_gaussians} Gaussians" if report.num_gaussians else ""
    return f"color {report.terms['color']:.4f}{count}"


@contextmanager
def _bar() -> Iterator[Observer]:
    from rich.console import Console
    from rich.progress import BarColumn, MofNCompleteColumn, Progress, TextColumn, TimeRemainingColumn

    stage, rate, facts = (TextColumn(f"{{task.{name}}}") for name in ("description", "fields[rate]", "fields[facts]"))
    columns = (stage, BarColumn(), MofNCompleteColumn(), rate, TimeRemainingColumn(), facts)
    with Progress(*columns, console=Console(stderr=True)) as progress:
        task = progress.add_task("starting", total=None, rate="", facts="")

        def observer(report: StepReport, trainer: Trainer) -> None:
            done, total = trainer.progress()
            rate, stage = f"{1 / max(report.seconds, 1e-9):.0f} it/s", report.stage.name.lower()
            progress.update(task, completed=done, total=total, description=stage, rate=rate, facts=_facts(report))

        yield observer
