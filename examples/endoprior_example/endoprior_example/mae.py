"""Mean absolute error of the rendered color."""

import numpy as np

from endoprior.evaluation.context import EvaluationContext
from endoprior.evaluation.score import Score

SCORES = (Score("mae", "mean absolute error", "%", False, 2, "Mean absolute color error on tissue, of full scale."),)


def compute(context: EvaluationContext) -> None:
    """Score every frame of the split."""
    rows = []
    for frame in context.frames:
        error = np.abs(context.rendered[frame.index].rgb - frame.rgb)[frame.tissue_mask]
        rows.append({"mae": 100 * float(error.mean()) if error.size else float("nan")})
    context.add_frames(rows, "no tissue in the split")
