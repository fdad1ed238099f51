"""How long a job will take: one figure for all its steps, said before the first one and corrected as they proceed.

Each part of a step has a usual time, measured on two cores. How much longer the finished parts took than that tells how
long the others will take; a part that counts what it has done tells it of itself.
"""

from __future__ import annotations

import time as clock
from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass, replace

from ..core.config import Config
from ..data.description import read_description
from ..runs import kernel_cache
from .job import Job, SequenceJob

COMPILE = "compile"  # name of the step that compiles kernels, before the others
COMPILE_S = 45.0  # usual time of it, s
TRUSTED_S = 8.0  # the usual times count as much as so many seconds of the finished parts of the job, s
OWN_S = 1.0  # what the job tells about a part counts as much as so many seconds of the part itself, s
USUAL_SIZE = (240, 640, 512)  # frames, width and height, px, of a folder that does not say


@dataclass(frozen=True)
class Part:
    """A part of a step, as progress names it."""

    step: str
    what: str
    seconds: Callable[[int], float]  # usual time of the first so many items, s
    count: int = 1  # items in it, as far as known; one if they are not counted

    @property
    def whole(self) -> float:
        """Usual time of all of it, s."""
        return self.seconds(self.count)


def parts_of(job: SequenceJob, waiting: Sequence[str]) -> list[Part]:
    """The parts of the steps of a job that are left, in order. Args: waiting: names of these steps."""
    frames, width, height = _size(job)
    mpx = width * height / 1e6

    def evenly(step: str, what: str, each: float, count: int = 1) -> Part:
        return Part(step, what, lambda done: each * done, count)

    parts = [
        evenly(COMPILE, "kernels, once", COMPILE_S / kernel_cache.USUAL_COUNT, kernel_cache.USUAL_COUNT),
        evenly("prepare", "looking through", 1.0 + 0.015 * frames),
        evenly("prepare", "looking for tools", 0.04, frames),
        evenly("prepare", "writing frames", 0.01 + 0.15 * mpx, frames),
        evenly("prepare", "following the camera", 0.03 + 0.15 * mpx, frames),
        *([evenly("prepare", "depth by parallax", 0.12, frames)] if _may_measure_by_motion(job) else []),
        evenly("check", "measuring", 2.0 + (0.005 + 0.08 * mpx) * frames),
        evenly("train", "starting", 1.5 + 0.1 * frames),
        Part("train", "training", training_seconds(job.cfg, mpx), iterations(job.cfg)),
        evenly("score", "rendering held-out frames", 4.0 + (0.03 + 0.4 * mpx) * frames),
        evenly("video", "rendering", 0.01 + 0.1 * mpx, frames),
        evenly("player", "packing", 0.4 + 0.013 * frames),
    ]
    return [part for part in parts if part.step in waiting]


def _may_measure_by_motion(job: SequenceJob) -> bool:
    """Whether `prepare` measures depth by the motion of the camera if that moves: a video without a calibration mostly
    has one camera."""
    if not isinstance(job, Job):
        return False
    return job.prepare.demands_motion or (job.prepare.depth == "auto" and job.prepare.calibration is None)


def iterations(cfg: Config) -> int:
    """Of a training of one window."""
    return cfg.schedule.coarse_iterations + cfg.schedule.fine_iterations


def training_seconds(cfg: Config, mpx: float) -> Callable[[int], float]:
    """Usual time of the first so many iterations, s; of several windows, they follow one another.

    The first ones are at half resolution, and faster. Args: mpx: size of a frame, millions of pixels.
    """
    whole, half = iterations(cfg), cfg.schedule.half_resolution_iterations
    fast, slow = (0.014 + 0.155 * mpx * share for share in (0.25, 1.0))

    def of_window(done: int) -> float:
        return fast * min(done, half) + slow * max(done - half, 0)

    return lambda done: done // whole * of_window(whole) + of_window(done % whole)


def _size(job: SequenceJob) -> tuple[int, int, int]:
    """Number of frames, and width and height, px, as far as known before they are there."""
    if isinstance(job, Job):
        width = job.prepare.max_width
        return job.part.num_frames, width or USUAL_SIZE[1], round((width or USUAL_SIZE[1]) * 0.65)
    file = job.data / "sequence.json"
    described = read_description(file) if file.is_file() else {}
    width, height = (
        described.get(name, usual) for name, usual in zip(("width", "height"), USUAL_SIZE[1:], strict=True)
    )
    count = len(list((job.data / "images").glob("*"))) if (job.data / "images").is_dir() else 0
    return count or USUAL_SIZE[0], int(width), int(height)


class Forecast:
    """The time that is left of all parts."""

    def __init__(self, parts: Iterable[Part], now: Callable[[], float] = clock.monotonic) -> None:
        """Args: now: a clock, s."""
        self._parts, self._now = list(parts), now
        self._at, self._done = 0, 0  # the part that is being done, and how many of its items are
        self._began = self._part_began = now()
        self._first: int | None = None  # items of the part that were done before; None: it has not counted yet

    def left(self) -> float:
        """Seconds until all parts are done."""
        if self._at >= len(self._parts):
            return 0.0
        now, part = self._now(), self._parts[self._at]
        before = sum(each.whole for each in self._parts[: self._at])
        own_s, took = now - self._part_began, self._part_began - self._began
        counted = part.seconds(self._done) - part.seconds(self._first or 0)  # usual time of what the part has counted
        if counted > 0:
            took += own_s
        slower = (took + TRUSTED_S) / (before + counted + TRUSTED_S)  # by which factor, than usual
        rest = max(part.whole - part.seconds(self._done), 0.0)
        if counted > 0:  # a part that counts tells its own speed
            here = rest * (own_s + OWN_S * slower) / (counted + OWN_S)
        else:
            here = max(rest * slower - own_s, 0.0)
        return here + slower * sum(each.whole for each in self._parts[self._at + 1 :])

    def at(self, step: str, what: str, done: int = 0, total: int = 0) -> None:
        """Say what is being done, and how far it is. A part that is not known belongs to the one before."""
        self._enter(lambda part: (part.step, part.what) == (step, what))
        part = self._parts[self._at] if self._at < len(self._parts) else None
        if part is not None and (part.step, part.what) == (step, what) and total and part.count > 1:
            self._parts[self._at], self._done = replace(part, count=total), done
            self._first = done if self._first is None else self._first

    def after(self, step: str, what: str, done: int, total: int) -> float:
        """`left` after `at`."""
        self.at(step, what, done, total)
        return self.left()

    def begin(self, step: str) -> None:
        """A step begins."""
        self._enter(lambda part: part.step == step)

    def _enter(self, is_it: Callable[[Part], bool]) -> None:
        """Go on to the first part of that kind, if it lies ahead."""
        for place in range(self._at + 1, len(self._parts)):
            if is_it(self._parts[place]) and not is_it(self._parts[self._at]):
                self._at, self._done, self._first, self._part_began = place, 0, None, self._now()
                return
