"""What the scene renders behind the tool, against the tissue that is really there; needs ground truth."""

from __future__ import annotations

import numpy as np

from .. import metrics
from ..context import EvaluationContext
from ..score import Score

SCORES = (
    Score(
        "psnr_behind_tool", "PSNR behind tool", "dB", True, 2,
        "PSNR of the pixels that the tool hides, against the true tissue; with ground truth only.",
        "absolute", group="image", hint="tissue that the tool hides",
    ),
    Score(
        "depth_rmse_behind_tool_mm", "depth behind tool", "mm", False, 3,
        "Root mean square depth error of the pixels that the tool hides; with ground truth only.",
        group="depth", hint="tissue that the tool hides",
    ),
)  # fmt: skip


def compute(context: EvaluationContext) -> None:
    """Score every frame of the split whose true tissue is known; nothing without ground truth."""
    truth = context.sequence.truth
    if truth is None:
        return
    with context.skip_if_unavailable("psnr_behind_tool"):
        values = []
        for frame in context.frames:
            if (true_color := truth.tissue(frame.index)) is not None:
                rendered, target = context.rendered[frame.index].rgb, true_color / np.float32(255)
                values.append(metrics.psnr_behind_tool(rendered, target, frame.tissue_mask))
        context.add_mean("psnr_behind_tool", values, "no true color behind the tool")
    with context.skip_if_unavailable("depth_rmse_behind_tool_mm"):
        values = []
        for frame in context.frames:
            if (true_depth := truth.depth(frame.index)) is not None:
                hidden = ~frame.tissue_mask & (true_depth > 0)
                values.append(metrics.depth_rmse(context.rendered[frame.index].depth, true_depth, hidden))
        context.add_mean("depth_rmse_behind_tool_mm", values, "no true depth behind the tool")
