"""From a sequence to a scene, in memory or in a run folder."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path

from .config import Config
from .data import Sequence
from .model.scene import Scene
from .run_folder import train_in_folder
from .train_state import StepReport
from .trainer import Trainer


def train(
    sequence: Sequence,
    cfg: Config,
    out: str | Path | None = None,
    *,
    resume: bool = False,
    on_step: Callable[[StepReport, Trainer], None] | None = None,
) -> Scene:
    """Train one scene.

    Args:
        sequence: from `load_sequence`.
        cfg: from `preset`.
        out: run folder for config, log, checkpoints and `scene.safetensors`; None keeps everything in memory.
        resume: continue from the checkpoint in `out`.
        on_step: called after each iteration.
    Raises:
        InputError: the sequence cannot be used, or `out` holds another run.
        KeyboardInterrupt: the user stopped; a checkpoint has been written.
    """
    sequence.validate()
    trainer = Trainer(sequence, cfg)
    if out is not None:
        return train_in_folder(trainer, Path(out), resume=resume, on_step=on_step)
    trainer.start()
    while not trainer.finished:
        report = trainer.step()
        if on_step:
            on_step(report, trainer)
    return trainer.scene()
