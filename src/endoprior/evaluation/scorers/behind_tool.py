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
        "psnr_behind_tool_seen", "PSNR behind tool, seen", "dB", True, 2,
        "The same where a training frame shows that tissue at another time.",
        "absolute", group="image", in_summary=False,
    ),
    Score(
        "psnr_behind_tool_guessed", "PSNR behind tool, guessed", "dB", True, 2,
        "The same where no training frame shows that tissue.",
        "absolute", group="image", in_summary=False,
    ),
    Score(
        "depth_rmse_behind_tool_mm", "depth behind tool", "mm", False, 3,
        "Root mean square depth error of the pixels that the tool hides; with ground truth only.",
        group="depth", hint="tissue that the tool hides",
    ),
)  # fmt: skip
NO_SEEN = "not known where tissue behind the tool is seen at another time"


def compute(context: EvaluationContext) -> None:
    """Score every frame of the split whose true tissue is known; nothing without ground truth."""
    truth = context.sequence.truth
    if truth is None:
        return
    with context.skip_if_unavailable(*(score.name for score in SCORES if score.group == "image")):
        values, seen, guessed = [], [], []
        for frame in context.frames:
            if (true_color := truth.tissue(frame.index)) is not None:
                rendered, target = context.rendered[frame.index].rgb, true_color / np.float32(255)
                values.append(metrics.psnr_behind_tool(rendered, target, frame.tissue_mask))
                # The truth was written for the published split: with another one, other frames are training frames.
                shown = truth.seen(frame.index) if context.sequence.test_phase == 0 else None
                if shown is not None:
                    seen.append(metrics.psnr_behind_tool(rendered, target, ~shown))
                    guessed.append(metrics.psnr_behind_tool(rendered, target, frame.tissue_mask | shown))
        context.add_mean("psnr_behind_tool", values, "no true color behind the tool")
        context.add_mean("psnr_behind_tool_seen", seen, NO_SEEN)
        context.add_mean("psnr_behind_tool_guessed", guessed, NO_SEEN)
    with context.skip_if_unavailable("depth_rmse_behind_tool_mm"):
        values = []
        for frame in context.frames:
            if (true_depth := truth.depth(frame.index)) is not None:
                hidden = ~frame.tissue_mask & (true_depth > 0)
                values.append(metrics.depth_rmse(context.rendered[frame.index].depth, true_depth, hidden))
        context.add_mean("depth_rmse_behind_tool_mm", values, "no true depth behind the tool")
