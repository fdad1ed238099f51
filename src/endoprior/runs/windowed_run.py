"""A training whose sequence is cut into windows: each is a run of its own, below `windows/` in the run folder."""

from __future__ import annotations

import json
import shutil
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from dataclasses import replace
from pathlib import Path

from ..core.checks import InputError, input_error, read_ranges
from ..core.config import Config
from ..data import FrameSequence
from ..model.scene_file import load_scene
from ..model.single_scene import SingleScene
from ..model.windowed_scene import Span, WindowedScene, save_index, window_file
from ..system.atomic import remove_leftovers, write_json, write_text
from ..system.file_lock import locked
from ..training.trainer import DEFAULT_FRAMES_PER_SECOND, Observer
from .folder import CONFIG, LOCK, LOG, SCENE, prepare_run_folder, read_log, reject_unusable_folder
from .identity import reject_other_start
from .observers import CHECKPOINT_SECONDS
from .provenance import run_facts
from .training_run import TrainingRun


def window_config(cfg: Config, start: int, stop: int) -> Config:
    """The config of the run of one window: an ordinary training on these frames of what `cfg` reads."""
    first = min(read_ranges("data.window", cfg.data.window), default=0)
    return replace(
        cfg,
        data=replace(cfg.data, window=f"{first + start}-{first + stop - 1}"),
        windows=replace(cfg.windows, enabled=False),
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
        created, began = prepare_run_folder(self.out, resume=self.resume), False
        try:
            with locked(self.out, self.out / LOCK):
                self._begin(self.out)
                began = True
                yield self.out
        except InputError:
            if created and not began:
                shutil.rmtree(self.out, ignore_errors=True)
            raise

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
            reject_other_start(about, self.cfg, fingerprint, self.sequence.path)
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
