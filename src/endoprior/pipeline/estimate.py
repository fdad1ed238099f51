"""Estimate how long a job takes: do every step on a few frames with a few iterations, and scale the times."""

from __future__ import annotations

import shutil
import time as clock
from bisect import bisect_left
from collections.abc import Callable
from dataclasses import dataclass, replace
from functools import partial
from itertools import islice
from pathlib import Path
from statistics import median
from typing import TypeVar

from ..core.config import Config
from ..data import load_sequence
from ..data.window_plan import windows_by_length
from ..evaluation.scorers.model import FPS_RENDERS, FPS_WARM_UP
from ..evaluation.scoring import evaluate, scored_data
from ..model.method import method_of
from ..prepare import prepare
from ..prepare.camera_path.choose import colmap_seconds
from ..prepare.camera_path.sequence_path import METHODS, ONLY_IF_MOVING, WITHOUT_COLMAP
from ..prepare.config import PrepareConfig
from ..prepare.first_pass import SAMPLES
from ..prepare.frames import REACH
from ..prepare.record import names_path
from ..prepare.sam2 import is_sam2
from ..prepare.source import open_source
from ..training.trainer import Trainer
from .job import Job
from .part import end_of_first
from .steps import STEPS, run_step

FRAMES = 10
"""Frames of the trial."""
ITERATIONS = 6
"""Timed iterations at each resolution, after one that is not timed."""
CHECK_FRAMES = 120
"""So many more frames double the time of `check`, most of which goes into a few samples. Measured: docs/log.md."""
RESERVE = 1.15
"""Whole jobs took 1.15 and 1.22 times what their trials said: Gaussians grow in number, caches fill (docs/log.md)."""
A = TypeVar("A")


@dataclass(frozen=True)
class Trial:
    """Seconds measured on the first `FRAMES` frames."""

    decode: float
    """One image of the video."""
    look: float
    """First pass of `prepare`."""
    learn: float
    """Fitting its models of tools and light to samples."""
    write: float
    """One frame of its second pass."""
    follow: float
    """Camera path."""
    check: float
    start: float
    """First points and their motion, and everything that is computed once for each frame."""
    half_iteration: float
    iteration: float
    render: float
    """One frame."""
    score: float
    rendered_video: float
    """One frame of the video."""
    player: float


def estimate(job: Job) -> dict[str, float]:
    """Seconds of each step of a job, by its name. Takes some 20 s itself, and leaves nothing behind."""
    folder = job.out / ".endoprior.trial"
    shutil.rmtree(folder, ignore_errors=True)
    try:
        source = open_source(job.source, job.prepare.folder_rate)
        end = end_of_first(source.times, source.frames_per_second, job.part, job.part.num_frames)
        images = bisect_left(source.times, end)
        colmap = 0.0 if job.prepare.poses in ONLY_IF_MOVING else seconds_of_colmap(job)
        seconds = scaled(_measure(job, folder), job.cfg, job.part.num_frames, images, colmap)
        return {name: RESERVE * value for name, value in seconds.items()}
    finally:
        shutil.rmtree(folder, ignore_errors=True)


def seconds_if_moving(job: Job) -> float:
    """About how much longer a job takes than `estimate` says if the camera turns out to move; 0 if that is known."""
    return seconds_of_colmap(job) if job.prepare.poses in ONLY_IF_MOVING else 0.0


def seconds_of_colmap(job: Job) -> float:
    """About how long COLMAP takes where it takes part in finding the camera path, s."""
    how = job.prepare.poses
    if how not in METHODS or job.prepare.depth == "none":
        return 0.0
    return colmap_seconds(METHODS[how], job.part.num_frames)


def scaled(trial: Trial, cfg: Config, num_frames: int, num_images: int, colmap: float = 0.0) -> dict[str, float]:
    """Seconds of each step of the whole job, from those of the trial.

    Args:
        num_frames: frames that are used.
        num_images: images of the video up to the last of them; both passes of `prepare` decode all.
        colmap: seconds that COLMAP takes, which takes no part in the trial.
    """
    more = num_frames / FRAMES
    half = min(cfg.schedule.half_resolution_iterations, cfg.schedule.fine_iterations)
    full = cfg.schedule.coarse_iterations + cfg.schedule.fine_iterations - half
    windows = windows_by_length(num_frames, cfg.windows) if cfg.windows.enabled else 1
    # Scoring renders some frames several times to measure the speed, however long the sequence is.
    speed = (FPS_WARM_UP + 2 * FPS_RENDERS) * trial.render
    return {
        "prepare": 2 * num_images * trial.decode
        + (trial.look - FRAMES * trial.decode) * min(SAMPLES, num_frames) / FRAMES
        + trial.learn
        + num_frames * (trial.write - trial.decode)
        + trial.follow * more
        + colmap,
        "check": trial.check * (1 + (num_frames - FRAMES) / CHECK_FRAMES),
        "train": trial.start * more + windows * (half * trial.half_iteration + full * trial.iteration),
        "score": max(trial.score - speed, 0.0) * more + speed,
        "video": trial.rendered_video * num_frames,
        "player": trial.player * more,
    }


def _measure(job: Job, folder: Path) -> Trial:
    """Do every step on the first frames, in `folder`."""
    short = replace(job, out=folder, prepare=trial_options(job))
    folder.mkdir(parents=True)
    stamps = Stamps()
    source = open_source(job.source, job.prepare.folder_rate)
    decode, _ = _timed(lambda: [None for _ in islice(source, FRAMES)])
    prepare(short.source, short.data, short.prepare, stamps)
    prepared = clock.perf_counter()
    looked, followed = stamps.at["looking through"][0], stamps.at["following the camera"][0]
    learned, write = stamps.at["looking at tools and light"][0], stamps.step("writing frames")

    cfg = shortened(job.cfg, job.part.num_frames)
    trainer = method_of(cfg).trainer(load_sequence(short.data, cfg.data), cfg)
    start, _ = _timed(partial(_start, trainer))
    iterations = [_timed(trainer.step)[0] for _ in range(2 * ITERATIONS + 2)]
    scene = trainer.scene()
    scene.save(short.run / "scene.safetensors")
    sequence = load_sequence(short.data, scored_data(job.cfg.data))
    score, result = _timed(lambda: evaluate(scene, sequence, networks=False))
    steps = {step.name: step for step in STEPS}
    check, _, player = (
        _timed(partial(run_step, steps[name], short, stamps))[0] for name in ("check", "video", "player")
    )
    return Trial(
        decode=decode / FRAMES,
        look=learned - looked,
        learn=stamps.at["writing frames"][0] - learned - REACH * write,  # the first frame waits for its neighbors
        write=write,
        follow=prepared - followed,
        check=check,
        start=start,
        half_iteration=median(iterations[1 : ITERATIONS + 1]),
        iteration=median(iterations[ITERATIONS + 2 :]),
        render=1 / result.scores["fps"],
        score=score,
        rendered_video=stamps.step("rendering"),
        player=player,
    )


def trial_options(job: Job) -> PrepareConfig:
    """Options of `prepare` for the first `FRAMES` frames, without the user's files, which fit all frames of the job."""
    cfg, source = job.prepare, open_source(job.source, job.prepare.folder_rate)
    end = end_of_first(source.times, source.frames_per_second, job.part, FRAMES)
    # On few frames COLMAP takes another time than its share: `seconds_of_colmap`.
    poses = WITHOUT_COLMAP.get(cfg.poses, cfg.poses) if seconds_of_colmap(job) else cfg.poses
    short = replace(cfg, end=min(end, cfg.end), poses=poses)
    if names_path(cfg.poses):
        short = replace(short, poses="still")
    if names_path(cfg.masks):
        short = replace(short, masks="none", mask_labels="")
    if is_sam2(cfg.masks):
        short = replace(short, masks="auto")
    return replace(short, depth="shading", depth_relative="no") if names_path(cfg.depth) else short


def shortened(cfg: Config, num_frames: int) -> Config:
    """A config with a few iterations at each resolution that cost what those of `cfg` cost.

    Args:
        num_frames: of the whole job, which decides the number of temporal basis functions.
    """
    half = ITERATIONS + 1
    schedule = replace(cfg.schedule, coarse_iterations=0, fine_iterations=2 * half, half_resolution_iterations=half)
    temporal = replace(cfg.temporal, start_iteration=half + 1)
    return replace(cfg.fitted(num_frames), schedule=schedule, temporal=temporal)


class Stamps:
    """A progress callback that keeps the time of each call."""

    def __init__(self) -> None:
        self.at: dict[str, list[float]] = {}

    def __call__(self, what: str, done: int, total: int) -> None:
        """See `Progress`."""
        self.at.setdefault(what, []).append(clock.perf_counter())

    def step(self, what: str) -> float:
        """Mean time between two calls, s."""
        times = self.at[what]
        return (times[-1] - times[0]) / max(len(times) - 1, 1)


def _start(trainer: Trainer) -> None:
    """Start the training, and fill its caches: in the trial, few iterations would meet a frame for the first time."""
    trainer.start()
    frames = trainer.step_once.frames
    for position in range(len(frames)):
        frames.frame(position, half=True)
        frames.prior(position)


def _timed(act: Callable[[], A]) -> tuple[float, A]:
    """Seconds of a call, and what it returns."""
    began = clock.perf_counter()
    value = act()
    return clock.perf_counter() - began, value
