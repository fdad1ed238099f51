"""How much of the change in the rendered video is color that changes with time, in place of motion."""

from __future__ import annotations

from ...model.fixed_color import changes_color, with_fixed_color
from .. import metrics
from ..context import EvaluationContext
from ..rendered import SceneFrames
from ..score import Score

SCORES = (
    Score(
        "color_share", "change by color", "", False, 3,
        "Squared change of tissue pixels when each Gaussian's color is fixed to its mean, over their variance in time.",
        "absolute", group="motion", hint="0: all by motion; 1: nothing moves",
    ),
)  # fmt: skip


def compute(context: EvaluationContext) -> None:
    """Score the frames of the split."""
    scene = context.scene
    if not changes_color(scene):
        raise metrics.ScoreUnavailable("the colors of this scene do not change with time")
    fixed = SceneFrames(with_fixed_color(scene, [frame.time for frame in context.frames]), context.sequence)
    by_color, count, total, squares = 0.0, 0.0, 0.0, 0.0
    for frame in context.frames:
        mask = frame.tissue_mask[..., None]
        image = context.rendered[frame.index].color.astype("float64") * mask
        by_color += float(((image - fixed.render(frame.index)[0]) ** 2 * mask).sum())
        count, total, squares = count + mask, total + image, squares + image**2
    variance = float((squares - total**2 / (count + (count == 0))).sum())
    if variance <= 1e-12 * float(squares.sum()):
        raise metrics.ScoreUnavailable("nothing changes in the rendered frames of the split")
    context.add("color_share", by_color / variance)
