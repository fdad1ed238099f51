"""The log of a training, `log.jsonl`: how it is written, what it says afterwards of growth and of tool masks, and how
TensorBoard shows it.

TensorBoard's event files beside each `log.jsonl` are made from its lines, and from those only. Whoever follows a
training sees the values that the log has; what is resumed is not shown twice, because the files of the run are made
anew.
"""

from __future__ import annotations

import json
from collections import Counter
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import TYPE_CHECKING, Any, Literal, TextIO

from ..core.checks import InputError, frame_list, input_error
from ..core.config_io import from_dict
from ..core.shell import command, missing_package
from ..data.found_tools import read_rows
from ..data.reading import read_bytes
from ..model.scene import Scene
from ..system.atomic import read_json_object, write_text
from ..training.trainer import Observer, Stage, StepReport, Trainer
from .folder import CONFIG, LOG

if TYPE_CHECKING:
    from torch.utils.tensorboard import SummaryWriter

LOG_EVERY = 10  # iterations between two lines
MISSED = "missed_tool_frames"
"""Frames whose masks likely miss a tool: in the last line, in the protocol of `metrics.json` and in `StepReport`."""


def log_writer(lines: TextIO) -> Observer:
    """Writes a line of JSON every `LOG_EVERY` iterations, after events of density control, and at the end."""

    def observer(report: StepReport, _trainer: Trainer) -> None:
        missed = report.missed_tool_frames
        if report.iteration % LOG_EVERY and not report.event and missed is None:
            return
        line: dict[str, Any] = {"stage": report.stage.name.lower(), "iteration": report.iteration}
        line |= {"num_gaussians": report.num_gaussians}
        line |= {"event": report.event} if report.event else {}
        line |= {MISSED: missed} if missed is not None else {}
        line |= {"terms": report.terms, "seconds": round(report.seconds, 4)}
        lines.write(json.dumps(line) + "\n")

    return observer


def cut_log(log: Path, stage: Stage, iteration: int) -> None:
    """Drop the lines of iterations after a checkpoint: they will be written again."""
    if log.exists():
        lines = read_log(log, "stage", "iteration")
        kept = [line for line in lines if (Stage[line["stage"].upper()], line["iteration"]) <= (stage, iteration)]
        write_text(log, "".join(json.dumps(line) + "\n" for line in kept))


def read_log(log: Path, *names: str, after: int = 0) -> list[dict[str, Any]]:
    """The lines of `log.jsonl`, without a last one that a crash cut short; each must have the `names`.

    Args:
        after: lines at the start that are not looked at.
    Raises:
        InputError: it cannot be read, or another line is broken: no JSON, or a value of another type.
    """
    lines, rows = read_bytes(log, "the log of a training").tobytes().splitlines(), list[dict[str, Any]]()
    for number, text in enumerate(lines[after:], after + 1):
        try:
            row = json.loads(text)
        except (ValueError, RecursionError):
            row = None
        if isinstance(row, dict) and row.keys() >= set(names) and _is_line(row):
            rows.append(row)
        elif number < len(lines):
            found = ascii(text[:40].decode(errors="replace"))
            raise input_error(f"{log}, line {number}", "an iteration as JSON", found, "Remove this line.")
    return rows


@dataclass(frozen=True)
class _Line:
    """What a line of the log may hold."""

    stage: Literal["coarse", "fine"] = "fine"
    iteration: int = 0
    num_gaussians: int = 0
    event: dict[str, int] = field(default_factory=dict)
    missed_tool_frames: tuple[int, ...] = ()
    terms: dict[str, float] = field(default_factory=dict)
    seconds: float = 0.0
    window: int = 0


def _is_line(row: dict[str, Any]) -> bool:
    try:
        from_dict(_Line, row)
    except InputError:
        return False
    return True


def iterations_done(lines: Sequence[Mapping[str, Any]]) -> list[int]:
    """How many iterations were done at each line of a log: those of both stages and of all windows count."""
    done, before, last = list[int](), 0, dict[str, Any]()
    for line in lines:
        if last and (line["stage"], line.get("window")) != (last["stage"], last.get("window")):
            before += last["iteration"]
        done.append(before + line["iteration"])
        last = line
    return done


@dataclass(frozen=True)
class Growth:
    """Counts of Gaussians, of all windows together."""

    first: int  # in the first line of the log: before any event, unless one comes within the first iterations
    last: int
    num_events: int  # events of density control
    changes: Counter[str]
    """How many Gaussians were `cloned`, `split` or removed by a rule (`removed_RULE`); 0 for what never happened."""

    @property
    def ratio(self) -> float:
        """Gaussians at the end over those at the start."""
        return self.last / self.first


def growth_of(run: Path) -> Growth | None:
    """The growth in a run folder; None without a log, or where nothing grows, as in a radiance field."""
    if not (run / LOG).is_file():
        return None
    lines = read_log(run / LOG, "num_gaussians")
    first, last = (
        sum({line.get("window", 0): line["num_gaussians"] for line in ordered}.values())
        for ordered in (reversed(lines), lines)
    )
    events, changes = [line["event"] for line in lines if "event" in line], Counter[str]()
    for event in events:
        changes.update(event)
    return Growth(first, last, len(events), changes) if first else None


def mask_facts(run: Path) -> dict[str, Any]:
    """For the protocol of `metrics.json`: what the training in a run folder found out about tool masks."""
    missed = missed_tools_of(run)
    return {} if missed is None else {MISSED: missed}


def missed_tools_of(run: Path) -> list[int] | None:
    """Frames of the sequence, ascending, in a run folder; None where training trusted the masks, or has no log."""
    if not (run / LOG).is_file():
        return None
    windows, found = _windows(_config(run)), dict[int, set[int]]()
    for line in read_log(run / LOG):
        try:
            frames, first = line[MISSED], int(windows[line["window"]][0]) if "window" in line else 0
            found[first] = {first + int(frame) for frame in frames}  # of an extended run the last line counts
        except (ValueError, KeyError, TypeError, IndexError):  # most lines
            continue
    return sorted(set().union(*found.values())) if found else None


def missed_tools_line(run: Path, data: Path) -> str:
    """What to tell the user of a run on the sequence folder `data`; empty if nothing is likely missed.

    It names the frames in which `prepare` saw something move that no mask covers, too; none where training trusted the
    masks.
    """
    if (met := missed_tools_of(run)) is None:
        return ""
    try:
        moving = {row.frame for row in read_rows(data) if row.moves_unmasked}
    except InputError:  # training is done; a damaged list must not look like its failure
        moving = set()
    if not (frames := sorted({*met, *moving})):
        return ""
    steps = f"`{command('view', data)}`, then `{command('train', data, 'RUN')}`"
    return f"Tools are likely missed in {frame_list(frames)}. To look and correct: {steps}."


def _config(run: Path) -> dict[str, Any]:
    """The `config.json` of a run; empty where there is none that can be read."""
    return read_json_object(run / CONFIG) or {}


def _windows(about: dict[str, Any]) -> list[Any]:
    """First frame of each window and the one after its last, by `config.json`; none for a run of one window."""
    windows = about.get("windows")
    return windows if isinstance(windows, list) else []


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
            for line in read_log(log, "stage", "iteration", after=self._shown.get(folder, 0)):
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
