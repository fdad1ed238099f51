"""LPIPS of the rendered frames."""

from __future__ import annotations

from collections.abc import Callable

from .. import metrics
from ..context import NETWORKS_OFF, EvaluationContext
from ..score import Score

SCORES = (
    Score(
        "lpips", "LPIPS", "", False, 4,
        "The published one: perceptual distance of the masked images by AlexNet; needs its weights.",
        group="image", hint="0 is identical",
    ),
    Score(
        "lpips_squeeze", "LPIPS (squeeze)", "", False, 4,
        "The same by SqueezeNet, where its weights are on this machine.",
        group="image", in_summary=False,
    ),
)  # fmt: skip


def compute(context: EvaluationContext) -> None:
    """Score every frame of the split with each network whose weights are there."""
    if not context.networks:
        context.skip("lpips", NETWORKS_OFF)
        return
    for name, backbone in (("lpips", "alex"), ("lpips_squeeze", "squeeze")):
        with context.skip_if_unavailable(name):
            distance = metrics.lpips_distance(backbone, context.weights_dir, download=backbone == "alex")
            rows = [
                {name: distance(context.rendered[frame.index].rgb, frame.rgb, frame.tissue_mask)}
                for frame in context.frames
            ]
            context.add_frames(rows, "no tissue in the split")


def squeeze_distance(context: EvaluationContext, name: str) -> Callable[..., float] | None:
    """The distance by SqueezeNet; None, with the reason recorded for the score `name`, where it cannot be computed."""
    if not context.networks:
        context.skip(name, NETWORKS_OFF)
        return None
    with context.skip_if_unavailable(name):
        return metrics.lpips_distance("squeeze", context.weights_dir, download=False)
    return None
