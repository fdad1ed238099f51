"""Change of the rendered depth from frame to frame."""

from __future__ import annotations

from itertools import pairwise

from .. import metrics
from ..context import EvaluationContext
from ..score import Score

SCORES = (
    Score(
        "depth_instability_mm", "depth instability", "mm", False, 3,
        "The published one: mean absolute change of rendered depth on tissue between adjacent frames of the video.",
        group="depth", hint="includes true motion",
    ),
)  # fmt: skip


def compute(context: EvaluationContext) -> None:
    """Score all adjacent frames of the video, whatever the split."""
    values = [
        metrics.depth_instability(
            context.rendered[a.index].depth, context.rendered[b.index].depth, a.tissue_mask, b.tissue_mask
        )
        for a, b in pairwise(context.video)
    ]
    context.add_mean("depth_instability_mm", values, "no two adjacent frames share rendered tissue")
