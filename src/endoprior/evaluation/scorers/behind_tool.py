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
    color, depth = [], []
    for frame in context.frames:
        rendered = context.rendered[frame.index]
        true_color, true_depth = truth.tissue(frame.index), truth.depth(frame.index)
        if true_color is not None:
            target = true_color / np.float32(255)
            color.append(metrics.psnr_behind_tool(rendered.rgb, target, frame.tissue_mask))
        if true_depth is not None:
            hidden = ~frame.tissue_mask & (true_depth > 0)
            depth.append(metrics.depth_rmse(rendered.depth, true_depth, hidden))
    context.add_mean("psnr_behind_tool", color, "no true color behind the tool")
    context.add_mean("depth_rmse_behind_tool_mm", depth, "no true depth behind the tool")
