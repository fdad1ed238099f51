"""Shows a run in TensorBoard: event files beside each `log.jsonl`, made from its lines, and from those only.

Whoever follows a training sees the values that the log has; what is resumed is not shown twice, because the files of
the run are made anew.
"""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import TYPE_CHECKING, Any

from ..core.checks import InputError
from ..core.shell import missing_package
from ..model.scene import Scene
from ..training.trainer import StepReport, Trainer
from .folder import LOG
from .log import LOG_EVERY, read_log

if TYPE_CHECKING:
    from torch.utils.tensorboard import SummaryWriter

EVENTS = "events.out.tfevents.*"
IMAGE_EVERY = 100  # iterations between two images
WINDOWS = "windows/*"  # folders of the windows of a run


def writer_class() -> type[SummaryWriter]:
    """What writes event files; InputError with the command that installs it."""
    try:
        from torch.utils.tensorboard import SummaryWriter
    except ImportError as error:
        raise InputError(f"--tensorboard: {missing_package('tensorboard', 'tensorboard', error)}") from None
    return SummaryWriter


class EventFiles:
    """The event files of a run folder; an observer of its training."""

    def __init__(self, run: Path) -> None:
        """Nothing is read or written before the first call. InputError: TensorBoard is not installed."""
        self._new_writer, self._run = writer_class(), run
        self._writers: dict[Path, SummaryWriter] = {}  # by folder of the log
        self._shown: dict[Path, int] = {}  # how many lines of each log are shown
        self._first_fine: dict[Path, int] = {}  # iterations of the coarse stage, which count too

    def __call__(self, report: StepReport, trainer: Trainer) -> None:
        """Show what the log has got since, and now and then the first training frame as it is rendered."""
        if report.iteration % LOG_EVERY:
            return
        news = self.follow()
        if news and report.iteration % IMAGE_EVERY == 0 and isinstance(scene := trainer.scene(), Scene):
            folder, step = news
            frame = trainer.sequence.frames("train")[0]
            color = scene.render(frame.time, frame.camera).color.clamp(0, 1).cpu().numpy()
            self._writers[folder].add_image("first training frame", color, step, dataformats="HWC")

    def follow(self) -> tuple[Path, int] | None:
        """Show the new lines of every log; the folder and the step of the last one, None without news."""
        news = None
        for log in sorted([self._run / LOG, *self._run.glob(f"{WINDOWS}/{LOG}")]):
            folder = log.parent
            if not log.is_file() or (folder == self._run and any(self._run.glob(WINDOWS))):
                continue  # the log of several windows repeats theirs
            for line in read_log(log, "stage", "iteration")[self._shown.get(folder, 0) :]:
                news = folder, self._show(folder, line)
        return news

    def _show(self, folder: Path, line: dict[str, Any]) -> int:
        """Show one line; its step, which counts the iterations of both stages."""
        if folder not in self._writers:
            for old in folder.glob(EVENTS):
                old.unlink()
            self._writers[folder] = self._new_writer(str(folder), flush_secs=5)
        writer, step = self._writers[folder], line["iteration"]
        if line["stage"] == "coarse":
            self._first_fine[folder] = step
        else:
            step += self._first_fine.get(folder, 0)
        terms = line.get("terms", {})
        values = {f"loss/{name}": value for name, value in terms.items()} | {"loss": sum(terms.values())}
        values |= {"Gaussians": line.get("num_gaussians"), "seconds an iteration": line.get("seconds")}
        values |= {f"density/{name}": count for name, count in line.get("event", {}).items()}
        for name, value in values.items():
            if value is not None:
                writer.add_scalar(name, value, step)
        self._shown[folder] = self._shown.get(folder, 0) + 1
        return step

    def finish(self, scores: Mapping[str, float], step: int) -> None:
        """Show what is left of the logs, and the scores of held-out frames, after `step` iterations."""
        self.follow()
        writer = self._new_writer(str(self._run)) if self._run not in self._writers else self._writers[self._run]
        for name, value in scores.items():
            writer.add_scalar(f"held-out frames/{name}", value, step)
        for each in {writer, *self._writers.values()}:
            each.close()
