"""Tissue below highlights, once they are taken out of a scene (`--no-highlights`), against a phantom's truth."""

from __future__ import annotations

import numpy as np

from ...core.types import to_uint8
from ...model.colors import changes_color
from ...model.highlights import without_highlights
from ..context import EvaluationContext
from ..score import Score
from .image import psnr_tissue

MIN_HIGHLIGHT_LEVELS = 10.0
"""Pixels count where a highlight adds at least this much to the mean of the three colors, of 255."""
SCORES = (
    Score(
        "psnr_no_highlights", "PSNR below highlights", "dB", True, 2,
        "PSNR of tissue below highlights, these taken out, against the true tissue without them; ground truth only.",
        compare="absolute", group="image", in_summary=False,
    ),
    Score(
        "psnr_highlights_kept", "PSNR below highlights, kept", "dB", True, 2,
        "The same with the highlights as they were trained: how much there is to take out.",
        compare="absolute", group="image", in_summary=False,
    ),
)  # fmt: skip


def compute(context: EvaluationContext) -> None:
    """Score the frames of the split; nothing without ground truth, or of colors that do not change with time."""
    truth = context.sequence.truth
    with context.skip_if_unavailable(*(score.name for score in SCORES)):
        if truth is None or not truth.has_no_highlights or not changes_color(context.scene):
            return
        scene = without_highlights(context.scene, context.sequence.training_part)
        taken_out, kept = [], []
        for frame in context.frames:
            true, lit = truth.no_highlights(frame.index), truth.tissue(frame.index)
            if true is None or lit is None:
                continue
            below = frame.tissue_mask & (lit.mean(-1) - true.mean(-1) >= MIN_HIGHLIGHT_LEVELS)
            target = true / np.float32(255)
            rendered = to_uint8(scene.render(frame.time, frame.camera).color.cpu().numpy()) / np.float32(255)
            taken_out.append(psnr_tissue(rendered, target, below))
            kept.append(psnr_tissue(context.tissue_color(frame.index), target, below))
        context.add_mean("psnr_no_highlights", taken_out, "no tissue below highlights")
        context.add_mean("psnr_highlights_kept", kept, "no tissue below highlights")
