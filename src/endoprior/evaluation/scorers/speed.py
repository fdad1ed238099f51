"""Rendering speed, and the names of what training measures of itself."""

from __future__ import annotations

import time as clock
from collections.abc import Callable

from ...model.playback import Playback
from ...model.scene import RenderedScene
from ...system.devices import wait_for
from ..context import EvaluationContext
from ..score import Score

FPS_WARM_UP, FPS_RENDERS = 10, 60
LONGEST_SECONDS = 30.0
"""Time after which no further render starts: a radiance field may need minutes for one."""
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
        context.add("fps", frames_per_second(context.rendered_scene))
        context.add("fps_cached", frames_per_second(context.scene, cached=True))


def frames_per_second(scene: RenderedScene, *, cached: bool = False) -> float:
    """Speed of rendering the frames of the sequence one after the other, without input and output.

    Args:
        cached: deform the Gaussians of each frame beforehand, in a `Playback`; `scene` is a `Scene` then.
    """
    num_frames = min(len(scene.cameras), FPS_RENDERS)
    playback = Playback(scene) if cached else None

    def render(i: int) -> None:
        if playback:
            playback.render(i % num_frames)
        else:
            scene.render(i % num_frames / len(scene.cameras))

    _rate(render, num_frames if cached else FPS_WARM_UP, scene)
    return _rate(render, FPS_RENDERS, scene)


def _rate(render: Callable[[int], None], most: int, scene: RenderedScene) -> float:
    """Renders a second: `most` of them, or as many as begin within `LONGEST_SECONDS`."""
    wait_for(scene.device)
    began, done = clock.perf_counter(), 0
    while done < most and (not done or clock.perf_counter() - began < LONGEST_SECONDS):
        render(done)
        done += 1
    wait_for(scene.device)
    return done / (clock.perf_counter() - began)
