"""Error of the rendered depth on tissue."""

from __future__ import annotations

from .. import metrics
from ..context import EvaluationContext
from ..score import Score

SCORES = (
    Score(
        "depth_rmse_mm", "depth RMSE", "mm", False, 3,
        "Root mean square error of rendered depth where depth was measured on tissue.",
        group="depth", hint="0 is exact; measured depth errs too",
    ),
    Score(
        "depth_rmse_endogaussian", "depth RMSE (EndoGaussian's)", "", False, 3,
        "The depth figure of EndoGaussian's program, whose 8-bit depths wrap; only to compare with its tables.",
        group="depth", in_summary=False,
    ),
)  # fmt: skip


def compute(context: EvaluationContext) -> None:
    """Score every frame of the split."""
    rows = []
    for frame in context.frames:
        depth, mask = context.rendered[frame.index].depth, frame.tissue_mask
        rows.append(
            {
                "depth_rmse_mm": metrics.depth_rmse(depth, frame.depth, mask & frame.depth_valid),
                "depth_rmse_endogaussian": metrics.depth_rmse_endogaussian(depth, frame.depth, mask),
            }
        )
    context.add_frames(rows, "no tissue with measured depth")
