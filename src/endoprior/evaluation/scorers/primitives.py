"""Counts of Gaussians: all of them, and those that the paper's diagnostics distrust."""

from __future__ import annotations

from collections import Counter

from ...model.single_scene import SingleScene
from ..context import EvaluationContext
from ..score import Score

LOW_PRIOR, LOW_PRIOR_OBSERVATIONS, LOW_OPACITY, LARGE_SCALE_MM = 0.2, 20, 0.01, 40.0
"""The paper's thresholds."""
SCORES = (
    Score(
        "num_gaussians", "Gaussians", "", None, 0,
        "Gaussians of the scene, in all its windows.",
        group="model", hint="more are finer and slower",
    ),
    # Commands that know the run folder add it: a scene does not know how it began.
    Score(
        "gaussians_growth", "Gaussians, end / start", "", None, 2,
        "Gaussians after the training over those before it.",
        "absolute", group="model", in_summary=False,
    ),
    Score(
        "num_low_prior", "low prior", "", None, 0,
        f"Gaussians seen at least {LOW_PRIOR_OBSERVATIONS} times whose texture-prior score is below {LOW_PRIOR}.",
        "absolute", group="model", hint="mostly seen in highlights or flat color",
    ),
    Score(
        "num_low_opacity", "low opacity", "", None, 0,
        f"Gaussians of opacity below {LOW_OPACITY}.", "absolute",
        group="model", in_summary=False,
    ),
    Score(
        "num_large_scale", "large scale", "", None, 0,
        f"Gaussians whose largest standard deviation exceeds {LARGE_SCALE_MM:g} mm.",
        "absolute", group="model", in_summary=False,
    ),
)  # fmt: skip


def compute(context: EvaluationContext) -> None:
    """Count; no frame is needed."""
    counts: Counter[str] = Counter()
    for window in context.scene.windows:
        counts.update(_counts(window.scene))
    for name, count in counts.items():
        context.add(name, count)


def _counts(scene: SingleScene) -> dict[str, int]:
    seen = scene.num_valid >= LOW_PRIOR_OBSERVATIONS
    return {
        "num_gaussians": len(scene),
        "num_low_prior": int((seen & (scene.prior_score < LOW_PRIOR)).sum()),
        "num_low_opacity": int((scene.gaussians.opacities < LOW_OPACITY).sum()),
        "num_large_scale": int((scene.gaussians.scales.amax(-1) > LARGE_SCALE_MM).sum()),
    }
