"""A score: the error of mean colors over squares of tissue, what the term of `own_loss.py` is about."""

import numpy as np

from endoprior.evaluation.context import EvaluationContext
from endoprior.evaluation.score import Score

SCORES = (Score("area_error", "area error", "%", False, 3, "Color error of 8 x 8 px means on tissue, of full scale."),)
AREA_PX = 8


def compute(context: EvaluationContext) -> None:
    """Score every frame of the split; squares that a tool touches do not count."""
    rows = []
    for frame in context.frames:
        height, width = (size // AREA_PX * AREA_PX for size in frame.tissue_mask.shape)
        squares = (height // AREA_PX, AREA_PX, width // AREA_PX, AREA_PX)
        error = (context.rendered[frame.index].rgb - frame.rgb)[:height, :width].reshape(*squares, 3).mean((1, 3))
        tissue = frame.tissue_mask[:height, :width].reshape(squares).all((1, 3))
        rows.append({"area_error": 100 * float(np.abs(error[tissue]).mean()) if tissue.any() else float("nan")})
    context.add_frames(rows, "no square of tissue in the split")
