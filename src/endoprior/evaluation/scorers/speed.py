"""Rendering speed, and the names of what training measures of itself."""

from __future__ import annotations

import time as clock

from ...model.playback import Playback
from ...model.scene import Scene
from ...system.devices import wait_for
from ..context import EvaluationContext
from ..score import Score

FPS_WARM_UP, FPS_RENDERS = 10, 60
SCORES = (
    Score(
        "fps", "rendering", "frames/s", True, 1,
        "Frames rendered a second, deformation included.",
        group="speed",
    ),
    Score(
        "fps_cached", "cached rendering", "frames/s", True, 1,
        "The same with deformations computed beforehand.",
        group="speed", hint="motion computed beforehand",
    ),
    # `endoprior train` and `endoprior bench` add these two: a scene does not know how long its training took.
    Score(
        "train_seconds", "training", "s", False, 1,
        "Time of the training, reading included; not after `--resume`.",
        group="speed",
    ),
    Score(
        "iterations_per_second", "training speed", "iterations/s", True, 2,
        "Training iterations a second, by the log of the run.",
        group="speed",
    ),
)  # fmt: skip


def compute(context: EvaluationContext) -> None:
    """Time the rendering; no frame is needed."""
    with context.skip_if_unavailable("fps", "fps_cached"):
        context.add("fps", frames_per_second(context.scene))
        context.add("fps_cached", frames_per_second(context.scene, cached=True))


def frames_per_second(scene: Scene, *, cached: bool = False) -> float:
    """Speed of rendering the frames of the sequence one after the other, without input and output.

    Args:
        cached: deform the Gaussians of each frame beforehand, in a `Playback`.
    """
    num_frames = min(len(scene.cameras), FPS_RENDERS)
    playback = Playback(scene) if cached else None

    def render(i: int) -> None:
        if playback:
            playback.render(i % num_frames)
        else:
            scene.render(i % num_frames / len(scene.cameras))

    for i in range(num_frames if cached else FPS_WARM_UP):
        render(i)
    wait_for(scene.device)
    began = clock.perf_counter()
    for i in range(FPS_RENDERS):
        render(i)
    wait_for(scene.device)
    return FPS_RENDERS / (clock.perf_counter() - began)
