"""Whether the borders between the windows of a scene show."""

from __future__ import annotations

import numpy as np

from ..context import EvaluationContext
from ..score import Score

SCORES = (
    Score(
        "seam_psnr", "seams", "dB", True, 2,
        "Tissue PSNR of frames in which two windows overlap, minus that of the others; scenes of several windows only.",
        group="image", hint="0: the borders do not show",
    ),
)  # fmt: skip


def compute(context: EvaluationContext) -> None:
    """Compare frames of the split; nothing for a scene of one window."""
    scene = context.scene
    if len(scene.windows) == 1:
        return
    scored = [(row["time"], row["psnr_tissue"]) for row in context.result.per_frame if "psnr_tissue" in row]
    values = np.array([value for _, value in scored])
    at_seam = np.array([len(scene.shown_at(time)) > 1 for time, _ in scored], bool)
    difference = np.nan
    if at_seam.any() and not at_seam.all():
        difference = values[at_seam].mean() - values[~at_seam].mean()
    context.add("seam_psnr", float(difference), "no frame of the split lies in an overlap of windows, or all do")
