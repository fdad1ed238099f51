"""One scene of one window, in memory or in a run folder. Interruption saves; resuming is bit-identical."""

from __future__ import annotations

import shutil
from collections.abc import Callable
from pathlib import Path

from ..core.checks import InputError, input_error
from ..core.config import Config
from ..data import FrameSequence
from ..model.method import method_of
from ..model.scene import RenderedScene
from ..system.atomic import remove_leftovers, write_json, writing
from ..system.file_lock import locked
from ..system.memory import freed_memory_kept
from ..tool_masks.margin import with_tool_margin
from ..training.divergence import Diverged
from ..training.memory_check import reject_too_large
from ..training.trainer import Observer
from . import kernel_cache
from .checkpoint import load_checkpoint, save_checkpoint
from .folder import CHECKPOINT, CONFIG, LOCK, LOG, SCENE, prepare_run_folder, reject_unusable_folder
from .identity import reject_other_start
from .interrupt import deferred_interrupt
from .mask_facts import MARGIN, margin_note
from .observers import CHECKPOINT_SECONDS, CheckpointWriter, LogWriter, cut_log
from .provenance import run_facts

LAST_GOOD = "last_good.safetensors"
"""The scene just before its training diverged."""


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
            InputError: see `runs.train`.
        """
        self.out = Path(out) if out is not None else None
        self.resume = resume
        if self.out:
            reject_unusable_folder(self.out, resume=resume)
        reject_too_large(sequence, cfg)
        kernel_cache.fill(cfg, say)
        say(f"{sequence.path}: {len(sequence)} frames; backend {cfg.render.backend}")
        self.tool_margin_px: int | None = None
        """Pixels around tool masks that are left out; None where that was not asked."""
        if cfg.loss.tool_margin == "measured":
            sequence, self.tool_margin_px = with_tool_margin(sequence)
            say(margin_note(self.tool_margin_px))
        for warning in sequence.validate():
            say(f"note: {warning}")
        self.trainer = method_of(cfg).trainer(sequence, cfg)

    @freed_memory_kept()
    def complete(self, *observers: Observer, checkpoint_seconds: float = CHECKPOINT_SECONDS) -> RenderedScene:
        """Train to the end; `observers` are called after each iteration, in this order. See `runs.train`."""
        if self.out is None:
            self.trainer.start()
            self.trainer.run(list(observers))
            return self.trainer.scene()
        created, began = prepare_run_folder(self.out, resume=self.resume), False
        try:
            with locked(self.out, self.out / LOCK):
                fingerprint = self.trainer.sequence.fingerprint()
                self.trainer.sequence.demand_unchanged()  # what was read before is of the same state
                self._begin(self.out, fingerprint)
                began = True
                self._train_in(self.out, fingerprint, list(observers), checkpoint_seconds)
                scene = self.trainer.scene()
                scene.save(self.out / SCENE)
        except InputError:
            if created and not began:
                shutil.rmtree(self.out, ignore_errors=True)
            elif not (began or self.resume):
                (self.out / CONFIG).unlink(missing_ok=True)
            raise
        return scene

    def _begin(self, out: Path, fingerprint: str) -> None:
        """Start or restore the trainer, and write what must be known to repeat the run."""
        trainer, checkpoint, about = self.trainer, out / CHECKPOINT, out / CONFIG
        if self.resume and checkpoint.is_file():
            load_checkpoint(trainer, checkpoint, fingerprint)
        elif self.resume and about.is_file():  # stopped before its first checkpoint
            reject_other_start(about, trainer.cfg, fingerprint, trainer.sequence.path)
        elif self.resume:
            raise input_error(checkpoint, "a checkpoint to resume from", "none", "start without --resume.")
        remove_leftovers(out)  # not before the run was accepted and has the lock
        facts = run_facts(trainer.sequence, trainer.cfg, fingerprint)
        write_json(about, facts if self.tool_margin_px is None else facts | {MARGIN: self.tool_margin_px})
        if trainer.state is None:
            trainer.start()
        cut_log(out / LOG, trainer.state.stage, trainer.state.iteration)

    def _train_in(self, out: Path, fingerprint: str, observers: list[Observer], checkpoint_seconds: float) -> None:
        """Iterate to the end or to an interruption, with log and checkpoints in `out`."""
        trainer, checkpoint, lines = self.trainer, out / CHECKPOINT, out / LOG
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
