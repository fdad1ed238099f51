"""What to do with one video or sequence folder: its part, its settings, and where the results go."""

from __future__ import annotations

import json
import math
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, replace
from itertools import count, islice
from pathlib import Path
from typing import Any

from typing_extensions import override

from ..core.checks import InputError, input_error
from ..core.config import Config
from ..core.config_io import to_dict
from ..core.shell import Options, changed_options, command
from ..data import load_sequence
from ..data.files import entries
from ..data.reading import read_json
from ..prepare.camera_path.sequence_path import WITHOUT_COLMAP
from ..prepare.config import PrepareConfig
from ..prepare.first_pass import input_facts, source_facts
from ..prepare.source import ImageFolder, open_source
from ..prepare.video_clip import FrameSelection, Moment
from ..prepare.work_folder import work_lock
from ..system.atomic import reject_occupied, write_json
from ..system.file_lock import locked
from .choice import SCAN, SegmentChoice, choose_segment

MIN_RATE = 10.0  # frame rate, 1/s, below which tissue and camera move too far between two frames to be followed
MAX_FRAMES = 10_000
USUAL_FRAMES = 300  # a video with more frames loses some in between, as long as tissue can be followed
PREVIEW_FRAMES = 60
PREVIEW_WIDTH = 320  # width of the frames of a preview, px
DATA = "data"  # folder in the output folder: the sequence that a video is prepared to
SETTINGS = "settings.json"
"""File in the output folder with everything that decides the results: a job that is resumed must have the same."""
MAX_NAMED = 4  # differences that a message names; more are counted


@dataclass(frozen=True)
class Part:
    """Part of a video."""

    frames_per_second: float  # rate of the frames that are used
    start: float  # first time, seconds
    end: float  # end time, seconds, not included; infinite for the end of the video
    num_frames: int  # number of frames
    is_whole: bool  # whether it reaches the end that was asked for


def choose_part(
    times: Sequence[float], rate: float, wanted_rate: float, start: float, end: float, most: int,
    usual: int | None = None,
) -> Part:  # fmt: skip
    """The first part of a video that has at most `most` frames.

    A long video loses frames in between, down to `MIN_RATE`, until it has at most `usual`, then its end.

    Args:
        times: when each image of the video is shown, s, ascending.
        rate, wanted_rate: usual one of the video, and that which the user chose, 1/s; 0 for none.
        start, end: times that the user chose; the end may be infinite.
        usual: None: `most`.
    """

    def chosen(used: float, most: int) -> list[float]:
        """Times of the frames, up to `most`, that `prepare` selects."""
        picked = FrameSelection(used, start, end, rate).pick(map(Moment, count(), times))
        return [image.seconds for image in islice(picked, most)]

    every = 1
    if not wanted_rate:
        most_skipped, usual = max(math.floor(rate / MIN_RATE), 1), usual or most
        every = max(math.ceil(len(chosen(rate, most_skipped * usual)) / usual), 1)
    used = wanted_rate or rate / every
    frames = chosen(used, most + 1)
    if len(frames) <= most:
        return Part(used, start, end, len(frames), True)
    # Half a step after the last one, on the grid start, start + 1 / rate, ..., keeps rounding from adding one.
    end = start + (round((frames[most - 1] - start) * used) + 0.5) / used
    return Part(used, start, end, sum(time < end - 1e-9 for time in frames), False)


def _in_out(name: str, doc: str) -> property:
    return property(lambda self: self.out / name, doc=doc)


@dataclass(frozen=True)
class SequenceJob:
    """A sequence folder on its way to a scene. Results are in `out`."""

    source: Path  # what the user gave: the sequence folder
    out: Path
    cfg: Config

    run = _in_out("run", "The run folder: scene, scores, log, checkpoints.")
    figure = _in_out("check.png", "The figure of `check`.")
    findings = _in_out("check.json", "Facts and findings of `check`.")
    notes = _in_out("notes.json", "What each finished step told the user.")
    report = _in_out("report.png", "One image of held-out frames, curves and scores.")
    rendered_video = _in_out("video.mp4", "Input, rendered model and depth beside each other.")
    player = _in_out("player.html", "The page that plays the scene in a browser.")

    @property
    def is_preview(self) -> bool:
        """Whether it is a first look: few and small frames, a short training."""
        return False

    @property
    def data(self) -> Path:
        """The sequence folder."""
        return self.source


@dataclass(frozen=True)
class Job(SequenceJob):
    """A video on its way to a scene; it is prepared first."""

    options: Options  # what the user chose, as it is typed: `{"--preview": (), "--end": ("2.5",)}`; all else follows
    prepare: PrepareConfig  # options of `prepare`, for `part` only
    part: Part
    choice: SegmentChoice | None = None  # the segment that was chosen; None if the user chose the part
    rate_is_assumed: bool = False  # whether nothing tells the frame rate of a folder of images

    @property
    @override
    def is_preview(self) -> bool:
        return "--preview" in self.options

    @property
    @override
    def data(self) -> Path:
        return self.out / DATA


def make_job(
    video: Path, out: Path, prepare: PrepareConfig, cfg: Config, *, preset: str = "default", preview: bool = False,
    segment: int = 0,
) -> Job:  # fmt: skip
    """Choose the part of the video and the sizes.

    Args:
        prepare: the user's options; frame rate and end are filled in.
        preset: what the user calls `cfg`; a preview has its own.
        segment: number of a segment of the video's scan, from 1; 0 for the best one. Without effect if `prepare` has a
            start or an end.
        preview: at most `PREVIEW_FRAMES` frames of at most `PREVIEW_WIDTH` px, and no COLMAP unless it is asked for.
    Raises:
        InputError: the video cannot be read.
    """
    source = open_source(video, prepare.folder_rate)
    rate = source.frames_per_second
    most, usual = (PREVIEW_FRAMES, PREVIEW_FRAMES) if preview else (MAX_FRAMES, USUAL_FRAMES)
    choice = None
    if (prepare.start, prepare.end, prepare.stir) == (0, math.inf, None):
        choice = choose_segment(video, out, prepare.folder_rate, segment)
    start, end = choice.span if choice else (prepare.start, prepare.end)
    part = choose_part(source.times, rate, prepare.frames_per_second, start, end, most, usual)
    if choice and not part.is_whole:  # so many seconds, but the best ones
        start = choice.best_start(part.end - start)
        part = choose_part(source.times, rate, prepare.frames_per_second, start, end, most, usual)
    width = min(prepare.max_width or PREVIEW_WIDTH, PREVIEW_WIDTH) if preview else prepare.max_width
    poses = WITHOUT_COLMAP["auto"] if preview and prepare.poses == "auto" else prepare.poses
    chosen = replace(
        prepare, frames_per_second=part.frames_per_second, start=start, end=part.end, max_width=width, poses=poses
    )
    options: Options = {"--preview": ()} if preview else {"--preset": (preset,)} if preset != "default" else {}
    options |= {"--seed": (str(cfg.seed),)} if cfg.seed else {}
    options |= {"--segment": (str(segment),)} if segment else {}
    is_assumed = isinstance(source, ImageFolder) and source.rate_is_assumed
    return Job(video, out, cfg, options | changed_options(prepare), chosen, part, choice, is_assumed)


def open_folder(job: SequenceJob) -> bool:
    """Create the output folder, or accept that of an interrupted job with the same settings; whether it was there.

    As long as no step has a result, other settings take the place of those that are stored.

    Raises:
        InputError: the folder holds something else, or a job with other settings; it names them.
    """
    file, given = job.out / SETTINGS, json.loads(json.dumps(_settings(job)))
    if not file.is_file():
        reject_occupied(job.out)
        job.out.mkdir(parents=True, exist_ok=True)
        write_json(file, given)
        _keep_scan(job)
        return False
    show = f"; what is in this one: `{command('view', job.run)}`" * (job.run / "scene.safetensors").is_file()
    stored = read_json(file, f"pass another folder for the results{show}.")
    if not (found := differences(stored, given)):
        return True
    if any(path.exists() for path in (job.findings, job.run, job.out / DATA)):
        got = "; ".join(found[:MAX_NAMED]) + (f"; and {len(found) - MAX_NAMED} more" if found[MAX_NAMED:] else "")
        fix = "give the stored settings to resume, or choose another folder."
        raise input_error(job.out, "results of the same video and options", got, fix)
    with locked(job.out, work_lock(job.out / DATA)):  # else another process prepares it with the stored ones
        write_json(file, given)
        _keep_scan(job)
    return False


def _keep_scan(job: SequenceJob) -> None:
    if isinstance(job, Job) and job.choice:
        write_json(job.out / SCAN, job.choice.scanned)


@contextmanager
def removed_if_rejected(job: SequenceJob) -> Iterator[None]:
    """Remove the folder of a job that bad input ends, unless it holds more than the settings."""
    try:
        yield
    except InputError:
        if {entry.name for entry in entries(job.out)} <= {SETTINGS, SCAN}:
            for name in (SETTINGS, SCAN):
                (job.out / name).unlink(missing_ok=True)
            job.out.rmdir()
        raise


def differences(stored: dict[str, Any], given: dict[str, Any]) -> list[str]:
    """What differs between two settings, one text for each: `--end: stored 2.5, given 3`.

    Numbers that follow from the video and the options are named only if these are equal: after an update, for instance.
    """
    if stored.keys() != given.keys() or not all(isinstance(stored[part], dict) for part in given):
        return ["settings of another version"]
    named = []
    if stored["video"] != given["video"]:
        names = [facts.get("name") for facts in (stored["video"], given["video"])]
        changed = ", which has changed" if names[0] == names[1] else ""
        named.append(f"VIDEO: stored {names[0]}, given {names[1]}{changed}")
    before, now = stored["options"], given["options"]
    for name in {**before, **now}:
        if before.get(name) != now.get(name):
            texts = [_text(before.get(name), now.get(name)), _text(now.get(name), before.get(name))]
            named.append(f"{name}: stored {texts[0]}, given {texts[1]}")
        elif (facts := given["inputs"].get(name)) and facts != stored["inputs"].get(name):
            named.append(f"{name}: {facts['name']}, which has changed")
    before, now = _flat(stored["derived"]), _flat(given["derived"])
    changed = [name for name in {**before, **now} if before.get(name) != now.get(name)]
    return named or [f"{name}: stored {before.get(name)}, given {now.get(name)}" for name in changed]


def _settings(job: SequenceJob) -> dict[str, Any]:
    """Everything that decides the results of a job."""
    if not isinstance(job, Job):
        facts = {"name": job.source.name, "fingerprint": load_sequence(job.source, job.cfg.data).fingerprint()}
        return {"video": facts, "inputs": {}, "options": {}, "derived": {"config": to_dict(job.cfg)}}
    prepare = {name: repr(value) for name, value in vars(job.prepare).items()}
    derived = {"prepare": prepare, "config": to_dict(job.cfg)}
    inputs = input_facts(job.prepare)
    return {"video": source_facts(job.source), "inputs": inputs, "options": job.options, "derived": derived}


def _text(words: Any, others: Any) -> str:
    """The words after an option; None if it was not given."""
    if words is None:
        return "no" if others == [] else "the default"
    return " ".join(map(str, words)) or "yes" if isinstance(words, list) else str(words)


def _flat(values: dict[str, Any], prefix: str = "") -> dict[str, Any]:
    """The entries of a nested dict by their dotted names."""
    flat = {}
    for name, value in values.items():
        flat |= _flat(value, f"{prefix}{name}.") if isinstance(value, dict) else {f"{prefix}{name}": value}
    return flat
