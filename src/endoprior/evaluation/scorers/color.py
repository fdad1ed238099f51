"""How much of the change in the rendered video is color that changes with time, in place of motion."""

from __future__ import annotations

import numpy as np

from ...model.colors import changes_color, with_fixed_color
from .. import metrics
from ..context import EvaluationContext
from ..rendered import SceneFrames
from ..score import Score

SCORES = (
    Score(
        "color_share", "change by color", "", False, 3,
        "Share of the change of rendered tissue over time that is lost when colors are fixed: motion does not make it.",
        "absolute", group="motion", hint="0: all by motion; 1: nothing moves",
    ),
)  # fmt: skip


def compute(context: EvaluationContext) -> None:
    """Score the frames of the split."""
    scene = context.scene
    if not changes_color(scene):
        raise metrics.ScoreUnavailable("the colors of this scene do not change with time")
    fixed = SceneFrames(with_fixed_color(scene, [frame.time for frame in context.frames]), context.sequence)
    by_color = count = total = squares = np.float64(0)
    for frame in context.frames:
        mask = frame.tissue_mask[..., None]
        image = np.float64(mask) * context.rendered[frame.index].color
        by_color += (mask * (image - fixed.render(frame.index)[0]) ** 2).sum()
        count, total, squares = count + mask, total + image, squares + image**2
    change = (squares - total**2 / np.maximum(count, 1)).sum()  # over time, around the mean of each pixel
    if change <= 1e-12 * squares.sum():
        raise metrics.ScoreUnavailable("nothing changes in the rendered frames of the split")
    context.add("color_share", by_color / change)
