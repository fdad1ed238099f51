"""What a run folder records while training: lines of the log, and checkpoints."""

from __future__ import annotations

import json
import time as clock
from collections.abc import Callable
from pathlib import Path
from typing import Any, TextIO

from ..system.atomic import write_text
from ..training.stage import Stage, StepReport
from ..training.trainer import Trainer
from .checkpoint import save_checkpoint
from .folder import read_log
from .missed_tools import KEY

LOG_EVERY = 10
"""Iterations between two lines of `log.jsonl`."""
CHECKPOINT_SECONDS = 60.0
"""Longest time of work that a crash can cost, besides the iteration in progress, unless told otherwise."""
CHECKPOINT_SHARE = 0.05
"""Share of the time that writing checkpoints may take: large states are written less often."""


class LogWriter:
    """Writes a line of JSON every `LOG_EVERY` iterations, after events of density control, and at the end."""

    def __init__(self, lines: TextIO) -> None:
        self._lines = lines

    def __call__(self, report: StepReport, trainer: Trainer) -> None:
        """See `Observer`."""
        if report.iteration % LOG_EVERY == 0 or report.event or report.missed_tool_frames is not None:
            self._lines.write(json.dumps(_log_line(report)) + "\n")


class CheckpointWriter:
    """Writes a checkpoint every `seconds`, and before an interruption takes effect."""

    def __init__(self, path: Path, fingerprint: str, seconds: float, interrupted: Callable[[], bool]) -> None:
        """Args: fingerprint: of the sequence. interrupted: whether the user asked to stop."""
        self._path, self._fingerprint, self._seconds, self._interrupted = path, fingerprint, seconds, interrupted
        self._due_at = clock.monotonic() + seconds

    def __call__(self, report: StepReport, trainer: Trainer) -> None:
        """See `Observer`.

        Raises:
            KeyboardInterrupt: the user asked to stop; the checkpoint has been written.
        """
        stop = self._interrupted()
        if stop or clock.monotonic() >= self._due_at:
            began = clock.monotonic()
            trainer.synchronize()
            save_checkpoint(trainer, self._path, self._fingerprint)
            taken = clock.monotonic() - began
            self._due_at = clock.monotonic() + max(self._seconds, taken / CHECKPOINT_SHARE)
        if stop:
            raise KeyboardInterrupt


def _log_line(report: StepReport) -> dict[str, Any]:
    line = {"stage": report.stage.name.lower(), "iteration": report.iteration, "num_gaussians": report.num_gaussians}
    event = {"event": report.event} if report.event else {}
    missed = {} if report.missed_tool_frames is None else {KEY: report.missed_tool_frames}
    return line | event | missed | {"terms": report.terms, "seconds": round(report.seconds, 4)}


def cut_log(log: Path, stage: Stage, iteration: int) -> None:
    """Drop the lines of iterations after a checkpoint: they will be written again."""
    if not log.exists():
        return
    lines = read_log(log, "stage", "iteration")
    kept = [line for line in lines if (Stage[line["stage"].upper()], line["iteration"]) <= (stage, iteration)]
    write_text(log, "".join(json.dumps(line) + "\n" for line in kept))
