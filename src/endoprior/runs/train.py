"""From a sequence to a scene, in memory or in a run folder: in one window or in several."""

from __future__ import annotations

import logging
from collections.abc import Callable
from contextlib import nullcontext
from dataclasses import fields
from pathlib import Path

from ..core.checks import input_error
from ..core.config import Config
from ..data import FrameSequence, load_sequence
from ..data.window_plan import look_through, plan_windows
from ..model.method import method_of
from ..model.scene import RenderedScene
from ..system.console import complain
from ..training.preflight import note_on_budget, reject_ignored_options
from ..training.trainer import Observer
from .checkpoint import CHECKPOINT_SECONDS
from .folder import config_of_run, sequence_of_run
from .progress import is_watched, training_progress
from .training_run import TrainingRun, WindowedRun

log = logging.getLogger(__name__)


def train(
    sequence: FrameSequence | None = None,
    cfg: Config | None = None,
    out: str | Path | None = None,
    *,
    resume: bool = False,
    checkpoint_seconds: float = CHECKPOINT_SECONDS,
    on_step: Observer | None = None,
    progress: bool | None = None,
) -> RenderedScene:
    """Train one scene.

    Args:
        sequence: from `load_sequence`, read as `cfg.data` says; None with `resume`: the sequence of the run.
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
    run = start_run(sequence, cfg, out, resume=resume, say=complain if progress else log.info)
    with training_progress() if progress else nullcontext() as show_progress:
        observers = [observer for observer in (show_progress, on_step) if observer is not None]
        return run.complete(*observers, checkpoint_seconds=checkpoint_seconds)


def _check_reading(sequence: FrameSequence, cfg: Config) -> None:
    """Raise InputError if the sequence was read in another way than the config says; both eyes are read in any case."""
    for field in fields(cfg.data):
        wanted, found = getattr(cfg.data, field.name), getattr(sequence.reading or cfg.data, field.name)
        if wanted != found and field.name not in ("format", "eyes"):
            got = f"a sequence that was read with {found!r}"
            raise input_error(f"data.{field.name}", repr(wanted), got, "`load_sequence(DATA, config.data)`.")


def start_run(
    sequence: FrameSequence,
    cfg: Config,
    out: str | Path | None = None,
    *,
    resume: bool = False,
    say: Callable[[str], None],
) -> TrainingRun | WindowedRun:
    """A run whose sequence, config and folder have been checked; its `complete` trains.

    Args:
        say: takes lines for the user: what takes long, and what is suspicious about the sequence.
    Raises:
        InputError: see `train`.
    """
    reject_ignored_options(cfg)
    if note := note_on_budget(cfg):
        say(f"note: {note}")
    _check_reading(sequence, cfg)
    if cfg.windows.longest:
        cameras = [sequence.camera(i) for i in range(len(sequence))]
        whole = sequence.part(0, len(sequence))  # with a cache of its own, which is freed
        plan = plan_windows(cameras, look_through(whole), cfg.windows.longest)
        if len(plan) > 1 and not method_of(cfg).has_gaussians:
            want, got = f"0 with method {cfg.method}, which trains one window", f"a plan of {len(plan)} windows"
            raise input_error("windows.longest", want, got, "Add --windows.longest 0.")
        if len(plan) > 1:
            return WindowedRun(sequence, cfg, plan, out, resume=resume, say=say)
    return TrainingRun(sequence, cfg, out, resume=resume, say=say)
