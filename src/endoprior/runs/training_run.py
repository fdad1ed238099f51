"""From a sequence to a scene, in memory or in a run folder. Interruption saves; resuming is bit-identical."""

from __future__ import annotations

import logging
import shutil
import sys
from collections.abc import Callable
from contextlib import nullcontext
from pathlib import Path

from ..core.checks import InputError
from ..core.config import Config
from ..data import FrameSequence, load_sequence
from ..data.files import read_json
from ..model.scene import Scene
from ..system.atomic import write_json, writing
from ..system.file_lock import locked
from ..training.divergence import Diverged
from ..training.memory_check import reject_too_large
from ..training.trainer import Observer, Trainer
from . import kernel_cache
from .checkpoint import load_checkpoint, save_checkpoint
from .folder import LOCK, prepare_run_folder, reject_unusable_folder
from .identity import reject_other_run
from .interrupt import deferred_interrupt
from .observers import CHECKPOINT_SECONDS, CheckpointWriter, LogWriter, cut_log
from .progress import is_watched, training_progress
from .provenance import run_facts
from .stored_run import config_of_run, sequence_of_run

log = logging.getLogger(__name__)

CHECKPOINT = "checkpoint.safetensors"
LAST_GOOD = "last_good.safetensors"
"""The scene just before its training diverged."""


def train(
    sequence: FrameSequence | None = None,
    cfg: Config | None = None,
    out: str | Path | None = None,
    *,
    resume: bool = False,
    checkpoint_seconds: float = CHECKPOINT_SECONDS,
    on_step: Observer | None = None,
    progress: bool | None = None,
) -> Scene:
    """Train one scene.

    Args:
        sequence: from `load_sequence`; None with `resume`: the sequence of the run.
        cfg: from `preset`; None with `resume`: the config of the run.
        out: run folder for config, log, checkpoints and `scene.safetensors`; None keeps everything in memory.
        resume: continue the run in `out`, from its last checkpoint if there is one.
        checkpoint_seconds: time between two checkpoints.
        on_step: called as `on_step(report, trainer)` after each iteration; see `StepReport` for what it gets.
        progress: print notes about the sequence, rate and remaining time; None: on a terminal or in a notebook only.
    Raises:
        InputError: the sequence cannot be used, needs more memory than there is, or `out` holds another run.
        Diverged: the loss or a gradient is not finite, or the images show nothing; `out` keeps the state before.
        CannotWrite: a file cannot be written; the last complete state is kept.
        KeyboardInterrupt: the user stopped; a checkpoint has been written.
        ValueError: no sequence or no config without `resume`.
    """
    if resume and out is not None:
        cfg = config_of_run(Path(out)) if cfg is None else cfg
        sequence = load_sequence(sequence_of_run(Path(out)), cfg.data) if sequence is None else sequence
    if sequence is None or cfg is None:
        raise ValueError("train needs a sequence and a config; only with resume=True and out it takes those of the run")
    if progress is None:
        progress = is_watched()
    run = TrainingRun(sequence, cfg, out, resume=resume, say=_print_note if progress else log.info)
    with training_progress() if progress else nullcontext() as show_progress:
        observers = [observer for observer in (show_progress, on_step) if observer is not None]
        return run.complete(*observers, checkpoint_seconds=checkpoint_seconds)


def _print_note(text: str) -> None:
    print(text, file=sys.stderr, flush=True)


class TrainingRun:
    """A run whose sequence, config and folder have been checked, and which is ready to compute."""

    def __init__(
        self,
        sequence: FrameSequence,
        cfg: Config,
        out: str | Path | None = None,
        *,
        resume: bool = False,
        say: Callable[[str], None],
    ) -> None:
        """Check everything, cheap checks first, and compile the kernels if that was not done before.

        Args:
            say: takes lines for the user: what takes long, and what is suspicious about the sequence.
        Raises:
            InputError: see `train`.
        """
        self.out = Path(out) if out is not None else None
        self.resume = resume
        if self.out:
            reject_unusable_folder(self.out, resume=resume)
        reject_too_large(sequence, cfg)
        kernel_cache.fill(cfg, say)
        say(f"{sequence.path}: {len(sequence)} frames; backend {cfg.render.backend}")
        for warning in sequence.validate():
            say(f"note: {warning}")
        self.trainer = Trainer(sequence, cfg)

    def complete(self, *observers: Observer, checkpoint_seconds: float = CHECKPOINT_SECONDS) -> Scene:
        """Train to the end; `observers` are called after each iteration, in this order. See `train`."""
        if self.out is None:
            self.trainer.start()
            self.trainer.run(list(observers))
            return self.trainer.scene()
        created, began = prepare_run_folder(self.out, resume=self.resume), False
        try:
            with locked(self.out, self.out / LOCK):
                fingerprint = self.trainer.sequence.fingerprint()
                self._begin(self.out, fingerprint)
                began = True
                self._train_in(self.out, fingerprint, list(observers), checkpoint_seconds)
                scene = self.trainer.scene()
                scene.save(self.out / "scene.safetensors")
        except InputError:
            if created and not began:
                shutil.rmtree(self.out, ignore_errors=True)
            elif not (began or self.resume):
                (self.out / "config.json").unlink(missing_ok=True)
            raise
        return scene

    def _begin(self, out: Path, fingerprint: str) -> None:
        """Start or restore the trainer, and write what must be known to repeat the run."""
        trainer, checkpoint, about = self.trainer, out / CHECKPOINT, out / "config.json"
        if self.resume and checkpoint.is_file():
            load_checkpoint(trainer, checkpoint, fingerprint)
        elif self.resume and about.is_file():  # stopped before its first checkpoint
            stored = read_json(about)
            data = stored.get("data")
            known = data.get("fingerprint") if isinstance(data, dict) else None
            reject_other_run(about, stored.get("config"), known, trainer.cfg, fingerprint, trainer.sequence.path)
        elif self.resume:
            raise InputError(f"{checkpoint}: expected a checkpoint to resume from; found none. Start without --resume.")
        write_json(about, run_facts(trainer, fingerprint))
        if trainer.state is None:
            trainer.start()
        cut_log(out / "log.jsonl", trainer.state.stage, trainer.state.iteration)

    def _train_in(self, out: Path, fingerprint: str, observers: list[Observer], checkpoint_seconds: float) -> None:
        """Iterate to the end or to an interruption, with log and checkpoints in `out`."""
        trainer, checkpoint, lines = self.trainer, out / CHECKPOINT, out / "log.jsonl"
        try:
            with (
                writing(lines),
                open(lines, "a", buffering=1, encoding="utf-8", newline="\n") as file,
                deferred_interrupt() as interrupted,
            ):
                writer = CheckpointWriter(checkpoint, fingerprint, checkpoint_seconds, interrupted)
                trainer.run([LogWriter(file), *observers, writer])
                save_checkpoint(trainer, checkpoint, fingerprint)
        except Diverged as error:
            save_checkpoint(trainer, checkpoint, fingerprint)
            trainer.scene().save(out / LAST_GOOD)
            state = trainer.state
            raise Diverged(
                f"{out}: {state.stage.name.lower()} iteration {state.iteration + 1}: {error}; the scene before is "
                f"{LAST_GOOD}."
            ) from error
