"""The path of the camera in the scene, against the true one, or a given one that stands in for it."""

from __future__ import annotations

from ...core.geometry import camera_to_world
from .. import metrics
from ..context import EvaluationContext
from ..score import Score

SCORES = (
    Score(
        "ate_mm", "camera path error", "mm", False, 3,
        "Root mean square distance of camera centers from the true ones, after alignment; with ground truth only.",
        group="motion", hint="0 is the true path", in_true_mm=True,
    ),
    Score(
        "rpe_mm", "camera step error", "mm", False, 3,
        "Root mean square error of the camera's translation from frame to frame.",
        group="motion", in_summary=False, in_true_mm=True,
    ),
    Score(
        "rpe_deg", "camera turn error", "deg", False, 3,
        "Mean angle by which the camera's turn from frame to frame is wrong.",
        group="motion", hint="0 turns as the true camera",
    ),
    Score(
        "rotation_error_deg", "camera rotation error", "deg", False, 3,
        "Mean angle between the camera's axes and the true ones, after alignment.",
        group="motion", in_summary=False,
    ),
)  # fmt: skip
ONE_FRAME = "a single frame has no motion"


def compute(context: EvaluationContext) -> None:
    """Compare the cameras of all frames, whatever the split; nothing without the true path."""
    if context.true_path is None:
        return
    scene = context.rendered_scene
    errors = metrics.trajectory_errors(
        camera_to_world(scene.cameras), context.true_path, with_scale=scene.lengths_are_relative
    )
    for score in SCORES:
        context.add(score.name, getattr(errors, score.name), ONE_FRAME)
