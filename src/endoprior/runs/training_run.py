"""A training of one window, or of several, in memory or in a run folder. Interruption saves; resuming is bit-identical.

The windows of a sequence are runs of their own, below `windows/` in the run folder.
"""

from __future__ import annotations

import json
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from dataclasses import replace
from pathlib import Path

from ..core.checks import input_error, read_ranges
from ..core.config import Config
from ..data import FrameSequence
from ..model.method import method_of
from ..model.scene import RenderedScene
from ..model.scene_file import load_scene
from ..model.single_scene import SingleScene
from ..model.windowed_scene import Span, WindowedScene, save_index, window_file
from ..system.atomic import remove_leftovers, write_json, write_text, writing
from ..system.memory import freed_memory_kept
from ..tool_masks.margin import with_tool_margin
from ..training.divergence import Diverged
from ..training.preflight import reject_too_large
from ..training.trainer import DEFAULT_FRAMES_PER_SECOND, Observer
from . import kernel_cache
from .checkpoint import CHECKPOINT_SECONDS, CheckpointWriter, deferred_interrupt, load_checkpoint, save_checkpoint
from .folder import (
    CHECKPOINT,
    CONFIG,
    LOG,
    SCENE,
    accept_resumed,
    held_folder,
    reject_unusable_folder,
    run_facts,
)
from .log import MARGIN, cut_log, log_writer, read_log

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
            found = f"tools color {self.tool_margin_px} px around their masks, which are left out"
            none = "tools do not color the pixels around their masks: none is left out"
            say(found if self.tool_margin_px else none)
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
        out, trainer = self.out, self.trainer
        fingerprint = trainer.sequence.fingerprint()
        with held_folder(out, resume=self.resume, begin=lambda: self._begin(out, fingerprint)):
            self._train_in(out, fingerprint, list(observers), checkpoint_seconds)
            scene = trainer.scene()
            scene.save(out / SCENE)
        return scene

    def _begin(self, out: Path, fingerprint: str) -> None:
        """Start or restore the trainer, and write what must be known to repeat the run."""
        trainer, checkpoint = self.trainer, out / CHECKPOINT
        trainer.sequence.demand_unchanged()  # what was read before is of the same state
        restored = self.resume and checkpoint.is_file()
        if restored:
            load_checkpoint(trainer, checkpoint, fingerprint)
        elif self.resume and (out / CONFIG).is_file():  # stopped before its first checkpoint
            accept_resumed(out, trainer.cfg, fingerprint, trainer.sequence.path)
        elif self.resume:
            raise input_error(checkpoint, "a checkpoint to resume from", "none", "start without --resume.")
        remove_leftovers(out)  # not before the run was accepted and has the lock
        facts = run_facts(trainer.sequence, trainer.cfg, fingerprint)
        write_json(out / CONFIG, facts if self.tool_margin_px is None else facts | {MARGIN: self.tool_margin_px})
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
                writer = CheckpointWriter(checkpoint, fingerprint, checkpoint_seconds, interrupted)
                trainer.run([log_writer(file), *observers, writer])
                save_checkpoint(trainer, checkpoint, fingerprint)
        except Diverged as error:
            save_checkpoint(trainer, checkpoint, fingerprint)
            trainer.scene().save(out / LAST_GOOD)
            state = trainer.state
            raise Diverged(
                f"{out}: {state.stage.name.lower()} iteration {state.iteration + 1}: {error}; the scene before is "
                f"{LAST_GOOD}."
            ) from error


def window_config(cfg: Config, start: int, stop: int) -> Config:
    """The config of the run of one window: an ordinary training on these frames of what `cfg` reads."""
    first = min(read_ranges("data.window", cfg.data.window), default=0)
    return replace(
        cfg,
        data=replace(cfg.data, window=f"{first + start}-{first + stop - 1}"),
        windows=replace(cfg.windows, longest=0),
    )


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
        say: Callable[[str], None],
    ) -> None:
        """Check the folder; every window is checked when it begins.

        Args:
            plan: first frame of each window, and the frame after its last.
        """
        self.sequence, self.cfg, self.plan, self.say = sequence, cfg, plan, say
        self.out, self.resume = Path(out) if out is not None else None, resume
        if self.out:
            reject_unusable_folder(self.out, resume=resume)
        say(f"{sequence.path}: {len(sequence)} frames in {len(plan)} windows")

    def complete(self, *observers: Observer, checkpoint_seconds: float = CHECKPOINT_SECONDS) -> WindowedScene:
        """Train every window that is not trained yet. See `TrainingRun.complete`."""
        if self.out is None:
            scenes = [self._train(k, None, observers, checkpoint_seconds) for k in range(len(self.plan))]
            return self._scene(scenes.__getitem__)
        with self.opened() as out:
            scene_file = out / SCENE
            for k in self.waiting(out):  # one at a time is in memory
                self._train(k, window_file(scene_file, k).parent, observers, checkpoint_seconds)
            return self.join(out)

    @contextmanager
    def opened(self) -> Iterator[Path]:
        """Begin or continue the run in its folder, which no other process can use meanwhile.

        Raises:
            InputError: the folder cannot take the run; one that was created is removed.
        """
        assert self.out is not None, "a run in memory has no folder"
        out = self.out
        with held_folder(out, resume=self.resume, begin=lambda: self._begin(out)):
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

    def _begin(self, out: Path) -> None:
        fingerprint, about = self.sequence.fingerprint(), out / CONFIG
        self.sequence.demand_unchanged()
        if self.resume and about.is_file():
            accept_resumed(out, self.cfg, fingerprint, self.sequence.path)
        elif self.resume:
            raise input_error(about, "a run to resume", "none", "start without --resume.")
        remove_leftovers(out)
        write_json(about, run_facts(self.sequence, self.cfg, fingerprint) | {"windows": self.plan})

    def _train(
        self, k: int, folder: Path | None, observers: Sequence[Observer], checkpoint_seconds: float
    ) -> SingleScene:
        start, stop = self.plan[k]
        self.say(self.window_name(k))
        part, cfg = self.sequence.part(start, stop), window_config(self.cfg, start, stop)
        resume = folder is not None and (folder / CONFIG).is_file()
        run = TrainingRun(part, cfg, folder, resume=resume, say=self.say)
        return run.complete(*observers, checkpoint_seconds=checkpoint_seconds)

    def _scene(self, read: Callable[[int], SingleScene]) -> WindowedScene:
        """Args: read: the scene of window k; one at a time is in memory."""
        spans = [Span(start, stop, len(read(k))) for k, (start, stop) in enumerate(self.plan)]
        return WindowedScene(
            config=self.cfg,
            cameras=tuple(self.sequence.camera(i) for i in range(len(self.sequence))),
            frames_per_second=self.sequence.frames_per_second or DEFAULT_FRAMES_PER_SECOND,
            spans=tuple(spans),
            read=read,
            lengths_are_relative=self.sequence.depth_is_relative,
        )
