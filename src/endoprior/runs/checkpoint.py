"""The state of a training run as one safetensors file, and when it is written: at intervals, and before it stops."""

from __future__ import annotations

import os
import signal
import time as clock
from collections.abc import Callable, Iterator, Mapping
from contextlib import contextmanager
from pathlib import Path
from typing import TYPE_CHECKING, Any

from ..core.checks import InputError
from ..core.config_io import to_dict
from ..model.hexplane import TOUCHED
from ..system.arrays_file import ArraySpec, load_arrays, rejecting, save_arrays
from ..system.signals import handled_by
from ..training.stage import Stage, StepReport, stage_length
from ..training.trainer import Trainer
from .folder import reject_other_run

if TYPE_CHECKING:
    from torch import Tensor

FORMAT = "endoprior-checkpoint-1"
CHECKPOINT_SECONDS = 60.0
"""Longest time of work that a crash can cost, besides the iteration in progress, unless told otherwise."""
CHECKPOINT_SHARE = 0.05
"""Share of the time that writing checkpoints may take: large states are written less often."""


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
        stop, began = self._interrupted(), clock.monotonic()
        if stop or began >= self._due_at:
            trainer.synchronize()
            save_checkpoint(trainer, self._path, self._fingerprint)
            now = clock.monotonic()
            self._due_at = now + max(self._seconds, (now - began) / CHECKPOINT_SHARE)
        if stop:
            raise KeyboardInterrupt


@contextmanager
def deferred_interrupt() -> Iterator[Callable[[], bool]]:
    """Hold back Ctrl-C and the signals of schedulers and closing terminals until an iteration is complete.

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


def save_checkpoint(trainer: Trainer, path: Path, fingerprint: str) -> None:
    """Write everything that the next iteration depends on.

    Args:
        fingerprint: of the sequence; a run only resumes on the same data.
    Raises:
        InputError: the data changed meanwhile; the checkpoint before is kept, which no changed frame went into.
    """
    trainer.sequence.demand_unchanged(fingerprint)
    about = {
        "stage": int(trainer.state.stage),
        "iteration": trainer.state.iteration,
        "config": to_dict(trainer.cfg),
        "fingerprint": fingerprint,
    }
    save_arrays(path, trainer.state.arrays(), about, FORMAT)


def load_checkpoint(trainer: Trainer, path: Path, fingerprint: str) -> None:
    """Restore the saved state in `trainer`.

    Raises:
        InputError: the file is missing or damaged, or belongs to another config or other data.
    """
    if not os.path.isfile(path):
        raise InputError(f"{path}: expected a checkpoint to resume from, got none. Fix: Start without --resume.")
    cfg, next_step = trainer.cfg, "Train again without --resume."

    def schema(about: dict[str, Any]) -> dict[str, ArraySpec]:
        reject_other_run(path, about["config"], about["fingerprint"], cfg, fingerprint, trainer.sequence.path)
        return trainer.schema()

    arrays, about = load_arrays(path, {FORMAT: schema}, next_step)
    with rejecting(path, "a training state", next_step):
        stage, iteration = Stage(about["stage"]), about["iteration"]
        length = stage_length(cfg, stage)
        if type(iteration) is not int or not 0 <= iteration <= length:
            raise InputError(
                f"expected 0 to {length} as iteration of the {stage.name.lower()} stage; got {iteration!r:.80}."
            )
        before = stage_length(cfg, Stage.COARSE) if stage is Stage.FINE else 0  # a method may keep its optimizer
        check_state(arrays, before + iteration)
        num_frames = len(trainer.sequence.indices("train"))
        for name, spec in trainer.schema().items():
            if "F" in spec.shape and (got := arrays[name].shape[spec.shape.index("F")]) != num_frames:
                raise InputError(f"expected {num_frames} training frames in {name}; got {got}.")
    trainer.restore(stage, iteration, arrays)


def check_state(arrays: Mapping[str, Tensor], iterations: int) -> None:
    """Reject arrays of a checkpoint, finite and of the right shapes, that no training can produce.

    Args:
        iterations: of all stages so far.
    Raises:
        InputError: naming the array.
    """
    for name, value in arrays.items():
        if name.startswith("stats.") or name.endswith((".second", ".exp_avg_sq")):
            valid, expected = bool((value >= 0).all()), "no negative number"
        elif name.endswith(".steps"):
            valid, expected = bool(((value >= 0) & (value <= iterations)).all()), f"0 to {iterations} steps"
        elif name == "left_out":
            valid, expected = bool(((value >= 0) & (value <= 1)).all()), "shares"
        elif name == "tracks.rows":
            num = len(arrays["tracks.coefficients"])
            valid, expected = bool(((value >= 0) & (value < num)).all()), f"rows below {num}"
        elif name.endswith(".marks"):
            touched = len(arrays["optimizer.plane_adam.exp_avg"])
            valid = bool((value <= TOUCHED).all()) and int(value.count_nonzero()) == touched
            expected = f"{touched} touched cells"
        else:
            continue
        if not valid:
            raise InputError(f"expected {expected} in {name}; got something else.")
