"""Estimate how long a job takes: do every step on a few frames with a few iterations, and scale the times."""

from __future__ import annotations

import shutil
import time as clock
from collections.abc import Callable
from dataclasses import dataclass, replace
from functools import partial
from itertools import islice
from pathlib import Path
from statistics import median
from typing import TypeVar

from ..core.config import Config
from ..data import load_sequence
from ..evaluation.scorers.speed import FPS_RENDERS, FPS_WARM_UP
from ..evaluation.scoring import evaluate, scored_data
from ..prepare import prepare
from ..prepare.first_pass import SAMPLES
from ..prepare.frames import REACH
from ..prepare.source import open_source
from ..training.trainer import Trainer
from .job import Job
from .steps import STEPS, run_step

FRAMES = 12
"""Frames of the trial."""
ITERATIONS = 6
"""Timed iterations at each resolution, after one that fills caches and is not timed."""
A = TypeVar("A")


@dataclass(frozen=True)
class Trial:
    """Seconds measured on the first `FRAMES` frames."""

    decode: float
    """One image of the video."""
    look: float
    """First pass of `prepare`."""
    write: float
    """One frame of its second pass."""
    follow: float
    """Camera path."""
    check: float
    start: float
    """First points and their motion."""
    half_iteration: float
    iteration: float
    render: float
    """One frame."""
    score: float
    film: float
    player: float


def estimate(job: Job) -> dict[str, float]:
    """Seconds of each step of a job, by its name. Takes some 10 s itself, and leaves nothing behind."""
    folder = job.out / ".trial"
    shutil.rmtree(folder, ignore_errors=True)
    try:
        source = open_source(job.video, job.prepare.folder_rate)
        end = job.part.start + (job.part.num_frames - 0.5) / job.part.frames_per_second
        images = round(end * source.frames_per_second)
        return scaled(_measure(job, folder), job.cfg, job.part.num_frames, images)
    finally:
        shutil.rmtree(folder, ignore_errors=True)


def scaled(trial: Trial, cfg: Config, num_frames: int, num_images: int) -> dict[str, float]:
    """Seconds of each step of the whole job, from those of the trial.

    Args:
        num_frames: frames that are used.
        num_images: images of the video up to the last of them; both passes of `prepare` decode all.
    """
    more = num_frames / FRAMES
    half = min(cfg.schedule.half_resolution_iterations, cfg.schedule.fine_iterations)
    full = cfg.schedule.coarse_iterations + cfg.schedule.fine_iterations - half
    # Scoring renders some frames several times to measure the speed, however long the sequence is.
    speed = (FPS_WARM_UP + 2 * FPS_RENDERS) * trial.render
    return {
        "prepare": 2 * num_images * trial.decode
        + (trial.look - FRAMES * trial.decode) * min(SAMPLES, num_frames) / FRAMES
        + num_frames * (trial.write - trial.decode)
        + trial.follow * more,
        "check": trial.check * more,
        "train": trial.start * more + half * trial.half_iteration + full * trial.iteration,
        "score": max(trial.score - speed, 0.0) * more + speed,
        "video": trial.film * more,
        "player": trial.player * more,
    }


def _measure(job: Job, folder: Path) -> Trial:
    """Do every step on the first frames, in `folder`."""
    part = job.part
    end = part.start + (FRAMES - 0.5) / part.frames_per_second
    short = replace(job, out=folder, prepare=replace(job.prepare, end=min(end, job.prepare.end)))
    folder.mkdir(parents=True)
    times: dict[str, list[float]] = {}

    def note_time(what: str, done: int, total: int) -> None:
        times.setdefault(what, []).append(clock.perf_counter())

    source = open_source(job.video, job.prepare.folder_rate)
    decode, _ = _timed(lambda: [None for _ in islice(source, FRAMES)])
    prepare(short.video, short.data, short.prepare, note_time)
    prepared = clock.perf_counter()
    looked, written, followed = (
        times[phase] for phase in ("looking through", "writing frames", "following the camera")
    )
    write = (written[-1] - written[0]) / max(len(written) - 1, 1)

    trainer = Trainer(load_sequence(short.data, job.cfg.data), shortened(job.cfg, part.num_frames))
    start, _ = _timed(trainer.start)
    iterations = [_timed(trainer.step)[0] for _ in range(2 * ITERATIONS + 2)]
    scene = trainer.scene()
    scene.save(short.run / "scene.safetensors")
    sequence = load_sequence(short.data, scored_data(job.cfg.data))
    score, result = _timed(lambda: evaluate(scene, sequence, networks=False))
    steps = {step.name: step for step in STEPS}
    check, film, player = (
        _timed(partial(run_step, steps[name], short, _quiet))[0] for name in ("check", "video", "player")
    )
    return Trial(
        decode=decode / FRAMES,
        look=written[0] - looked[0] - REACH * write,  # the first frame waits for its neighbors
        write=write,
        follow=prepared - followed[0],
        check=check,
        start=start,
        half_iteration=median(iterations[1 : ITERATIONS + 1]),
        iteration=median(iterations[ITERATIONS + 2 :]),
        render=1 / result.scores["fps"],
        score=score,
        film=film,
        player=player,
    )


def shortened(cfg: Config, num_frames: int) -> Config:
    """A config with a few iterations at each resolution that cost what those of `cfg` cost.

    Args:
        num_frames: of the whole job, which decides the number of temporal basis functions.
    """
    half = ITERATIONS + 1
    schedule = replace(cfg.schedule, coarse_iterations=0, fine_iterations=2 * half, half_resolution_iterations=half)
    temporal = replace(cfg.temporal, start_iteration=half + 1)
    return replace(cfg.fitted(num_frames), schedule=schedule, temporal=temporal)


def _quiet(what: str, done: int, total: int) -> None:
    """No progress."""


def _timed(act: Callable[[], A]) -> tuple[float, A]:
    """Seconds of a call, and what it returns."""
    began = clock.perf_counter()
    value = act()
    return clock.perf_counter() - began, value
