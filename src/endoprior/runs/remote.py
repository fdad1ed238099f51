"""Train on a Ray cluster: a window, or a sequence of one window, is one call that any machine can do and resume."""

from __future__ import annotations

import time as clock
from collections.abc import Callable
from dataclasses import dataclass, replace
from pathlib import Path

from ..core.config import Config
from ..data import load_sequence
from ..model.scene import RenderedScene, Scene
from ..model.scene_file import load_scene
from ..model.windowed_scene import window_file
from ..render import ON_GPU
from ..system.devices import Threads
from ..system.ray_cluster import Cluster
from .folder import CHECKPOINT_SECONDS, CONFIG, SCENE
from .train import TrainingRun, WindowedRun, window_config

RESTARTS = 3  # how often a training is resumed after its process died: a machine may be lost, or memory run out


@dataclass(frozen=True)
class Training:
    """A training in a folder of its own, as any process can do it that shares the file system."""

    name: str
    data: Path  # sequence folder, absolute
    cfg: Config
    folder: Path  # run folder, absolute
    resume: bool  # whether there must be a run in the folder already. One that is there is resumed in any case.
    threads: Threads
    checkpoint_seconds: float = CHECKPOINT_SECONDS
    extends: bool = False  # whether that run gets the length of this config

    def __str__(self) -> str:
        return self.name


@dataclass(frozen=True)
class Trained:
    """The result of a training; its scene is in the folder."""

    num_gaussians: int | None  # None for a scene that has none
    seconds: float
    notes: tuple[str, ...]  # lines for the user about the sequence

    def __str__(self) -> str:
        count = "" if self.num_gaussians is None else f", {self.num_gaussians:,} Gaussians"
        return f"trained in {self.seconds:.0f} s{count}"


def trainings(run: TrainingRun | WindowedRun, checkpoint_seconds: float = CHECKPOINT_SECONDS) -> list[Training]:
    """What is left to train of a run in a folder; a run of several windows has been `opened`."""
    assert run.out is not None, "other machines need a folder"
    out, threads = run.out.absolute(), Threads.of_this_process()
    if isinstance(run, TrainingRun):
        data, cfg = run.trainer.sequence.path.absolute(), run.trainer.cfg
        return [Training("the whole sequence", data, cfg, out, run.resume, threads, checkpoint_seconds, run.extends)]
    data, left = run.sequence.path.absolute(), []
    for k in run.waiting(out):
        cfg, folder = window_config(run.cfg, *run.plan[k]), window_file(out / SCENE, k).parent
        left.append(Training(run.window_name(k), data, cfg, folder, False, threads, checkpoint_seconds, True))
    return left


def train_here(training: Training) -> Trained:
    """Train in this process, from the last checkpoint if there is one."""
    training.threads.use()
    began, notes = clock.perf_counter(), list[str]()
    resume = training.resume or (training.folder / CONFIG).is_file()
    sequence = load_sequence(training.data, training.cfg.data)
    extends = resume and training.extends
    run = TrainingRun(sequence, training.cfg, training.folder, resume=resume, extends=extends, say=notes.append)
    scene = run.complete(checkpoint_seconds=training.checkpoint_seconds)
    found = tuple(note for note in notes if note.startswith("note: "))
    return Trained(len(scene) if isinstance(scene, Scene) else None, clock.perf_counter() - began, found)


def start_training_on(cluster: Cluster, key: object, training: Training, cores: int) -> None:
    """Train on a cluster with so many cores; `cluster.next` tells how `key` ended."""
    sent = replace(training, threads=replace(training.threads, numba=cores))
    cluster.start(key, train_here, sent, cores=cores, on_gpu=training.cfg.render.backend in ON_GPU, restarts=RESTARTS)


def complete_on(
    cluster: Cluster,
    run: TrainingRun | WindowedRun,
    say: Callable[[str], None],
    checkpoint_seconds: float = CHECKPOINT_SECONDS,
) -> RenderedScene:
    """Train a run in a folder on a cluster; the scene is bit-identical to that of `run.complete()`.

    If a window fails, the others are trained nevertheless, so that resuming trains this one only.

    Raises:
        InputError: see `train`.
    """
    if isinstance(run, TrainingRun):
        _train_all(cluster, trainings(run, checkpoint_seconds), say)
        assert run.out is not None
        return load_scene(run.out)
    with run.opened() as out:
        _train_all(cluster, trainings(run, checkpoint_seconds), say)
        return run.join(out)


def _train_all(cluster: Cluster, left: list[Training], say: Callable[[str], None]) -> None:
    """Train all of them, and say when each is done."""
    cores = cluster.cores_for(len(left))
    for training in left:
        start_training_on(cluster, training, training, cores)
    if left:
        say(f"on the cluster: {len(left)} to train, cores for each: {cores}")
    failures, told = [], set[str]()
    while cluster.num_running:
        ended = cluster.next()
        if ended.error is not None:
            failures.append(ended.error)
            say(f"{ended.key}: failed: {ended.error}")
            continue
        for note in ended.value.notes:
            if note not in told:
                say(note)
                told.add(note)
        say(f"{ended.key}: {ended.value}; {cluster.num_running} not done yet")
    if failures:
        raise failures[0]
