"""What a model costs: how many Gaussians, those that the paper's diagnostics distrust, and how fast it renders."""

from __future__ import annotations

import time as clock
from collections import Counter
from collections.abc import Callable

from ...model.playback import Playback
from ...model.scene import RenderedScene, Scene, SingleScene
from ...system.devices import wait_for
from ..context import SPEED_OFF, EvaluationContext
from ..score import Score, ScoreUnavailable

LOW_PRIOR, LOW_PRIOR_OBSERVATIONS, LOW_OPACITY, LARGE_SCALE_MM = 0.2, 20, 0.01, 40.0  # The paper's thresholds
FPS_WARM_UP, FPS_RENDERS = 10, 60
LONGEST_SECONDS = 30.0  # Time after which no further render starts: a radiance field may need minutes for one
SCORES = (
    Score(
        "num_gaussians", "Gaussians", "", None, 0,
        "Gaussians of the scene, in all its windows.",
        group="model", hint="more are finer and slower",
    ),
    Score(
        "gaussians_growth", "Gaussians, end / start", "", None, 2,
        "Gaussians after the training over those before it.",
        compare="absolute", group="model", in_summary=False,
    ),
    Score(
        "num_low_prior", "low prior", "", None, 0,
        f"Gaussians seen at least {LOW_PRIOR_OBSERVATIONS} times whose texture-prior score is below {LOW_PRIOR}.",
        compare="absolute", group="model", hint="mostly seen in highlights or flat color",
    ),
    Score(
        "num_low_opacity", "low opacity", "", None, 0,
        f"Gaussians of opacity below {LOW_OPACITY}.",
        compare="absolute", group="model", in_summary=False,
    ),
    Score(
        "num_large_scale", "large scale", "", None, 0,
        f"Gaussians whose largest standard deviation exceeds {LARGE_SCALE_MM:g} mm.",
        compare="absolute", group="model", in_summary=False,
    ),
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
    """Count, then time the rendering; no frame is needed."""
    with context.skip_if_unavailable(*(score.name for score in SCORES if score.group == "model")):
        counts: Counter[str] = Counter()
        for window in context.scene.windows:
            counts.update(_counts(window.scene))
        for name, count in counts.items():
            context.add(name, count)
    with context.skip_if_unavailable("fps", "fps_cached"):
        if not context.speed:
            raise ScoreUnavailable(SPEED_OFF)
        context.add("fps", frames_per_second(context.rendered_scene))
        context.add("fps_cached", frames_per_second(context.scene, cached=True))


def _counts(scene: SingleScene) -> dict[str, int]:
    seen = scene.num_valid >= LOW_PRIOR_OBSERVATIONS
    return {
        "num_gaussians": len(scene),
        "num_low_prior": int((seen & (scene.prior_score < LOW_PRIOR)).sum()),
        "num_low_opacity": int((scene.gaussians.opacities < LOW_OPACITY).sum()),
        "num_large_scale": int((scene.gaussians.scales.amax(-1) > LARGE_SCALE_MM).sum()),
    }


def frames_per_second(scene: RenderedScene, *, cached: bool = False) -> float:
    """Speed of rendering the frames of the sequence one after the other; `cached` deforms Gaussians beforehand."""
    num_frames = min(len(scene.cameras), FPS_RENDERS)
    playback = Playback(scene) if cached and isinstance(scene, Scene) else None

    def render(i: int) -> None:
        if playback:
            playback.render(i % num_frames)
        else:
            scene.render(scene.frame_time(i % num_frames))

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
