"""From a sequence to a scene: one window or several, in memory or in a run folder. Resuming is bit-identical.

The windows of a sequence are runs of their own, below `windows/` in the run folder.
"""

from __future__ import annotations

import json
import logging
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager, nullcontext, suppress
from dataclasses import fields, replace
from pathlib import Path

from ..check.findings import find_errors
from ..compute.parallel_kernels import start_threads
from ..core.checks import InputError, input_error, read_ranges
from ..core.config import Config
from ..core.types import Fingerprints
from ..data import FrameSequence, check_sequence, load_sequence
from ..data.window_plan import plan_windows, summarize_frames
from ..model.method import method_of
from ..model.scene import RenderedScene, SingleScene
from ..model.scene_file import load_scene
from ..model.uncertainty import with_error_sources
from ..model.windowed_scene import Span, WindowedScene, save_index, window_file
from ..system.atomic import write_text, writing
from ..system.console import complain
from ..system.memory import freed_memory_kept
from ..training.divergence import Diverged
from ..training.method import trainer_for
from ..training.preflight import note_on_budget, reject_ignored_options, reject_too_large
from ..training.trainer import DEFAULT_FRAMES_PER_SECOND, Observer
from . import kernel_cache
from .folder import (
    CHECKPOINT,
    CHECKPOINT_SECONDS,
    CONFIG,
    LOG,
    SCENE,
    checkpoint_writer,
    config_of_run,
    deferred_interrupt,
    held_folder,
    load_checkpoint,
    record_run,
    reject_unextendable,
    reject_unusable_folder,
    remove_results,
    save_checkpoint,
    sequence_of_run,
)
from .log import cut_log, log_writer, read_log
from .progress import is_watched, training_progress

LAST_GOOD = "last_good.safetensors"  # the scene just before its training diverged

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
        sequence: from `load_sequence`. One that was opened without a `DataConfig` is read as `cfg.data` says, another
            one must agree with it. None with `resume`: the sequence of the run.
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
        RuntimeError: this process is a fork of one that has rendered or trained.

    Example:
        >>> import endoprior
        >>> config = endoprior.preset("preview", iterations=3, gaussians=200)
        >>> scene = endoprior.train(endoprior.load_sequence("DATA"), config, out="RUN")
        >>> scene.render(time=0.5).expected_depth.shape
        torch.Size([48, 64])
    """
    if resume and out is not None:
        cfg = config_of_run(Path(out)) if cfg is None else cfg
        sequence = load_sequence(sequence_of_run(Path(out)), cfg.data) if sequence is None else sequence
    if sequence is None or cfg is None:
        raise ValueError("train needs a sequence and a config; only with resume=True and out it takes those of the run")
    check_sequence(sequence)
    if not isinstance(cfg, Config):
        fix = f"`endoprior.preset({cfg!r})`." if isinstance(cfg, str) else "`endoprior.preset('default')`."
        raise input_error("cfg", "a Config", repr(cfg) if isinstance(cfg, str) else type(cfg).__name__, fix)
    if progress is None:
        progress = is_watched()
    run = start_run(sequence, cfg, out, resume=resume, say=complain if progress else log.info)
    with training_progress() if progress else nullcontext() as show_progress:
        observers = [observer for observer in (show_progress, on_step) if observer is not None]
        return run.complete(*observers, checkpoint_seconds=checkpoint_seconds)


def start_run(
    sequence: FrameSequence,
    cfg: Config,
    out: str | Path | None = None,
    *,
    resume: bool = False,
    extends: bool = False,
    say: Callable[[str], None],
) -> TrainingRun | WindowedRun:
    """A run whose sequence, config and folder have been checked; its `complete` trains.

    Args:
        extends: the run to resume gets the length of `cfg`, which is `Config.extended` of its config.
        say: takes lines for the user: what takes long, and what is suspicious about the sequence.
    Raises:
        InputError: see `train`.
    """
    start_threads()
    reject_ignored_options(cfg)
    if note := note_on_budget(cfg):
        say(f"note: {note}")
    sequence = sequence.read_as(cfg.data)
    for field in fields(cfg.data):  # was the sequence read as the config says? Both eyes are in any case
        wanted, found = getattr(cfg.data, field.name), getattr(sequence.reading or cfg.data, field.name)
        if (field.name, wanted) == ("reliability", "ignored"):
            sequence = sequence.all_alike()
        elif wanted != found and field.name not in ("format", "eyes"):
            got = f"a sequence that was read with {found!r}"
            raise input_error(f"data.{field.name}", repr(wanted), got, "`load_sequence(DATA, config.data)`.")
    if extends and out is not None:
        reject_unextendable(Path(out), cfg, len(sequence))
    run = _checked_run(sequence, cfg, out, resume=resume, extends=extends, say=say)
    if not (resume or sequence.is_training_view):  # as `check` does, it looks at all frames
        for error in find_errors(sequence):
            say(f"check: {error}")
    return run


def _checked_run(
    sequence: FrameSequence,
    cfg: Config,
    out: str | Path | None,
    *,
    resume: bool,
    extends: bool,
    say: Callable[[str], None],
) -> TrainingRun | WindowedRun:
    """One window, or several."""
    if cfg.windows.longest:
        cameras = [sequence.camera(i) for i in range(len(sequence))]
        # Else looked at through a view with a cache of its own, which is freed.
        summaries = sequence.summaries or summarize_frames(sequence.part(0, len(sequence)))
        plan = plan_windows(cameras, summaries, cfg.windows.longest)
        if len(plan) > 1 and not method_of(cfg).has_gaussians:
            want, got = f"0 with method {cfg.method}, which trains one window", f"a plan of {len(plan)} windows"
            raise input_error("windows.longest", want, got, "Add --windows.longest 0.")
        if len(plan) > 1:
            return WindowedRun(sequence, cfg, plan, out, resume=resume, extends=extends, say=say)
    return TrainingRun(sequence, cfg, out, resume=resume, extends=extends, say=say)


class TrainingRun:
    """The run of one window, which has been checked and is ready to compute."""

    def __init__(
        self,
        sequence: FrameSequence,
        cfg: Config,
        out: str | Path | None = None,
        *,
        resume: bool = False,
        extends: bool = False,
        say: Callable[[str], None],
    ) -> None:
        """Check everything, cheap checks first, and compile the kernels if that was not done before."""
        self.out, self.resume, self.extends = Path(out) if out is not None else None, resume, extends
        if self.out:
            reject_unusable_folder(self.out, resume=resume)
        reject_too_large(sequence, cfg)
        kernel_cache.fill(cfg, say)
        say(f"{sequence.path}: {len(sequence)} frames; backend {cfg.render.backend}")
        for warning in sequence.validate():
            say(f"note: {warning}")
        self.trainer = trainer_for(sequence, cfg)
        for note in self.trainer.notes():
            say(f"note: {note}")

    @freed_memory_kept()
    def complete(self, *observers: Observer, checkpoint_seconds: float = CHECKPOINT_SECONDS) -> RenderedScene:
        """Train to the end; `observers` are called after each iteration, in this order. See `train`."""
        out, trainer, trained_on = self.out, self.trainer, self.trainer.sequence.fingerprints()
        if out is None:
            trainer.start()
            trainer.run(list(observers))
            return self._result(trained_on)
        with held_folder(out, resume=self.resume, begin=lambda: self._begin(out, trained_on.data)):
            self._train_in(out, trained_on.data, list(observers), checkpoint_seconds)
            scene = self._result(trained_on)
            scene.save(out / SCENE)
        return scene

    def _result(self, trained_on: Fingerprints) -> RenderedScene:
        """The trained scene, with what it was trained on."""
        scene = with_error_sources(self.trainer.scene(), self.trainer.sequence.frames("train"))
        return scene.with_fingerprints(trained_on)

    def _begin(self, out: Path, fingerprint: str) -> None:
        """Start or restore the trainer, and write what must be known to repeat the run."""
        trainer, checkpoint = self.trainer, out / CHECKPOINT
        restored = self.resume and checkpoint.is_file()  # not if it was stopped before its first checkpoint
        if restored:
            any_length = self.extends
            with suppress(InputError):  # after a kill, the checkpoint may be one from before the run was extended
                any_length |= config_of_run(out) == trainer.cfg
            load_checkpoint(trainer, checkpoint, fingerprint, any_length=any_length)
        if self.extends:
            remove_results(out)
        record_run(
            out,
            trainer.sequence,
            trainer.cfg,
            fingerprint,
            resume=self.resume and not restored,  # the checkpoint has been compared
            any_length=self.extends,
        )
        if not restored:
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
                writer = checkpoint_writer(checkpoint, fingerprint, checkpoint_seconds, interrupted)
                trainer.run([log_writer(file), *observers, writer])
                save_checkpoint(trainer, checkpoint, fingerprint)
        except Diverged as error:
            save_checkpoint(trainer, checkpoint, fingerprint)
            trainer.scene().save(out / LAST_GOOD)
            where = f"{trainer.state.stage.name.lower()} iteration {trainer.state.iteration + 1}"
            raise Diverged(f"{out}: {where}: {error}; the scene before is {LAST_GOOD}.") from error


def window_config(cfg: Config, start: int, stop: int) -> Config:
    """The config of the run of one window: an ordinary training on these frames of what `cfg` reads."""
    first = min(read_ranges("data.window", cfg.data.window), default=0)
    data = replace(cfg.data, window=f"{first + start}-{first + stop - 1}")
    return replace(cfg, data=data, windows=replace(cfg.windows, longest=0))


class WindowedRun:
    """A run of several windows, which are trained one after the other or elsewhere; see `TrainingRun`."""

    def __init__(
        self,
        sequence: FrameSequence,
        cfg: Config,
        plan: list[tuple[int, int]],
        out: str | Path | None,
        *,
        resume: bool,
        extends: bool = False,
        say: Callable[[str], None],
    ) -> None:
        """Check the folder; every window of the `plan`, from first frame to last + 1, is checked when it begins."""
        self.sequence, self.cfg, self.plan, self.say = sequence, cfg, plan, say
        self.out, self.resume, self.extends = Path(out) if out is not None else None, resume, extends
        if self.out:
            reject_unusable_folder(self.out, resume=resume)
        say(f"{sequence.path}: {len(sequence)} frames in {len(plan)} windows")

    def complete(self, *observers: Observer, checkpoint_seconds: float = CHECKPOINT_SECONDS) -> WindowedScene:
        """Train every window that is not trained yet. See `TrainingRun.complete`."""
        if self.out is None:
            scenes = [self._train(k, None, observers, checkpoint_seconds) for k in range(len(self.plan))]
            return self._scene(scenes.__getitem__)
        with self.opened() as out:
            for k in self.waiting(out):  # one at a time is in memory
                self._train(k, window_file(out / SCENE, k).parent, observers, checkpoint_seconds)
            return self.join(out)

    @contextmanager
    def opened(self) -> Iterator[Path]:
        """Begin or continue the run in its folder, which no other process can use meanwhile."""
        assert self.out is not None, "a run in memory has no folder"
        out = self.out

        def begin() -> None:
            fingerprint = self.sequence.fingerprint()
            if self.extends:
                for file in (out / SCENE, *(window_file(out / SCENE, k) for k in range(len(self.plan)))):
                    remove_results(file.parent)
            record_run(
                out,
                self.sequence,
                self.cfg,
                fingerprint,
                resume=self.resume,
                any_length=self.extends,
                windows=self.plan,
            )

        with held_folder(out, resume=self.resume, begin=begin):
            yield out

    def waiting(self, out: Path) -> list[int]:
        """The windows that are not trained yet."""
        return [k for k in range(len(self.plan)) if not window_file(out / SCENE, k).is_file()]

    def window_name(self, k: int) -> str:
        """`window 2 of 3: frames 7 to 16`."""
        start, stop = self.plan[k]
        return f"window {k + 1} of {len(self.plan)}: frames {start} to {stop - 1}"

    def join(self, out: Path) -> WindowedScene:
        """Write log and list of the windows, all of which are trained."""
        files, lines = [window_file(out / SCENE, k) for k in range(len(self.plan))], []
        for k, file in enumerate(files):
            lines += [json.dumps({"window": k} | line) + "\n" for line in read_log(file.parent / LOG)]
        write_text(out / LOG, "".join(lines))
        scene = self._scene(lambda k: load_scene(files[k]))
        save_index(out / SCENE, scene)
        return scene

    def _train(
        self, k: int, folder: Path | None, observers: Sequence[Observer], checkpoint_seconds: float
    ) -> RenderedScene:
        start, stop = self.plan[k]
        self.say(self.window_name(k))
        part, cfg = self.sequence.part(start, stop), window_config(self.cfg, start, stop)
        resume = folder is not None and (folder / CONFIG).is_file()
        run = TrainingRun(part, cfg, folder, resume=resume, extends=resume, say=self.say)  # to the length of `cfg`
        return run.complete(*observers, checkpoint_seconds=checkpoint_seconds)

    def _scene(self, read: Callable[[int], RenderedScene]) -> WindowedScene:
        """Args: read: the scene of window k; one at a time is in memory."""

        def window(k: int) -> SingleScene:
            scene = read(k)
            assert isinstance(scene, SingleScene), "only a method of Gaussians trains windows"
            return scene

        return WindowedScene(
            config=self.cfg,
            cameras=tuple(self.sequence.camera(i) for i in range(len(self.sequence))),
            frames_per_second=self.sequence.frames_per_second or DEFAULT_FRAMES_PER_SECOND,
            spans=tuple(Span(start, stop, len(window(k))) for k, (start, stop) in enumerate(self.plan)),
            read=window,
            lengths_are_relative=self.sequence.depth_is_relative,
            trained_on=self.sequence.fingerprints(),
        )
