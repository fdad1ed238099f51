"""From a sequence to a scene, in memory or in a run folder."""

from __future__ import annotations

import logging
from collections.abc import Callable
from pathlib import Path

from ..core.config import Config
from ..data import FrameSequence
from ..model.scene import Scene
from ..training.memory_check import refuse_too_large
from ..training.state import StepReport
from ..training.trainer import Trainer
from . import kernel_cache
from .folder import CHECKPOINT_SECONDS, RunOptions, train_in_folder

log = logging.getLogger(__name__)


def train(
    sequence: FrameSequence,
    cfg: Config,
    out: str | Path | None = None,
    *,
    resume: bool = False,
    checkpoint_seconds: float = CHECKPOINT_SECONDS,
    on_step: Callable[[StepReport, Trainer], None] | None = None,
) -> Scene:
    """Train one scene.

    Args:
        sequence: from `load_sequence`.
        cfg: from `preset`.
        out: run folder for config, log, checkpoints and `scene.safetensors`; None keeps everything in memory.
        resume: continue the run in `out`, from its last checkpoint if there is one.
        checkpoint_seconds: time between two checkpoints.
        on_step: called after each iteration.
    Raises:
        InputError: the sequence cannot be used, needs more memory than there is, or `out` holds another run.
        Diverged: the loss or a gradient is not finite, or the pictures show nothing; `out` keeps the state before.
        CannotWrite: the disk does not take what is written; the last whole state is kept.
        KeyboardInterrupt: the user stopped; a checkpoint has been written.
    """
    refuse_too_large(sequence, cfg)
    kernel_cache.fill(cfg, log.info)
    sequence.validate()
    trainer = Trainer(sequence, cfg)
    if out is not None:
        return train_in_folder(trainer, Path(out), RunOptions(resume, checkpoint_seconds), on_step=on_step)
    trainer.start()
    while not trainer.finished:
        report = trainer.step()
        if on_step:
            on_step(report, trainer)
    return trainer.scene()
