"""Progress of a training: a bar on a terminal, one updated line in a notebook, plain lines elsewhere."""

from __future__ import annotations

import sys
import time as clock
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from typing import TYPE_CHECKING

from ..system.console import say

if TYPE_CHECKING:
    from ..training.stage import StepReport
    from ..training.trainer import Observer, Trainer

PLAIN_EVERY_SECONDS = 10.0
"""Time between two lines in a log file."""
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
        yield _Lines(NOTEBOOK_EVERY_SECONDS, _say_in_place)
        print(file=sys.stderr)
    else:
        yield _Lines(PLAIN_EVERY_SECONDS, say)


def _in_notebook() -> bool:
    from rich.console import Console

    return Console().is_jupyter


def _say_in_place(line: str) -> None:
    """Replace the last line. Rich would need ipywidgets to do that in a notebook."""
    print(f"\r{line:<79}", end="", file=sys.stderr, flush=True)


class _Lines:
    """Passes a line to `show` every few seconds."""

    def __init__(self, every_seconds: float, show: Callable[[str], None]) -> None:
        self.every_seconds, self.show = every_seconds, show
        self.began = self.last = clock.monotonic()
        self.done = self.done_before = 0

    def __call__(self, report: StepReport, trainer: Trainer) -> None:
        done, total = trainer.progress()
        now = clock.monotonic()
        if self.done == 0 or done <= self.done:  # the first iteration, or that of the next window
            self.began, self.done_before = now - report.seconds, done - 1
        self.done = done
        if now - self.last < self.every_seconds and done < total:
            return
        self.last = now
        rate = (done - self.done_before) / max(now - self.began, 1e-9)
        left = (total - done) / max(rate, 1e-9)
        self.show(f"{report.stage.name.lower()} {done}/{total}  {rate:.1f} it/s  {left:.0f} s left  {_facts(report)}")


def _facts(report: StepReport) -> str:
    """The loss of the color, and how many Gaussians there are; a radiance field has none."""
    count = f"  {report.num_gaussians} Gaussians" if report.num_gaussians else ""
    return f"color {report.terms['color']:.4f}{count}"


@contextmanager
def _bar() -> Iterator[Observer]:
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

        def observer(report: StepReport, trainer: Trainer) -> None:
            done, total = trainer.progress()
            progress.update(
                task,
                completed=done,
                total=total,
                description=report.stage.name.lower(),
                rate=f"{1 / max(report.seconds, 1e-9):.0f} it/s",
                facts=_facts(report),
            )

        yield observer
