"""The scene as the right eye of a stereo endoscope sees it, against its picture, which no method trains on.

Only tissue that both eyes see counts, by measured depth (`footage/right_view.py`). The left picture, moved to the
right eye by that depth, is scored beside the scene.
"""

from __future__ import annotations

import numpy as np

from ...footage.right_view import measured_disparity, right_camera, warp_to_right
from .. import metrics
from ..context import EvaluationContext
from ..score import Score
from .lpips import squeeze_distance

SCORES = (
    Score(
        "right_psnr", "right eye PSNR", "dB", True, 2,
        "PSNR of tissue seen by both eyes, from the right one, not trained on but with --eyes both; stereo only.",
        "absolute", group="image", hint="a view never trained on",
    ),
    Score(
        "right_lpips", "right eye LPIPS", "", False, 4,
        "LPIPS by SqueezeNet of these pictures, where its weights are on this machine.",
        group="image", in_summary=False,
    ),
    Score(
        "right_psnr_warp", "right eye PSNR, warp", "dB", True, 2,
        "PSNR of these pixels in the left picture, moved to the right eye by measured depth; no scene is needed.",
        "absolute", group="image", in_summary=False,
    ),
)  # fmt: skip
NO_TISSUE = "no tissue with measured depth that both eyes see"


def compute(context: EvaluationContext) -> None:
    """Score every frame of the split; nothing without a right eye."""
    eye = context.sequence.right_eye
    if eye is None:
        return
    scene = None
    with context.skip_if_unavailable("right_psnr", "right_lpips"):  # rendered images: only the warp is scored
        scene = context.rendered_scene
    lpips = squeeze_distance(context, "right_lpips") if scene else None
    rows: list[dict[str, float]] = []
    for frame in context.frames:
        true = eye.image(frame.index) / np.float32(255)
        warped, counted = warp_to_right(frame.rgb, measured_disparity(frame, eye.baseline_mm), frame.tissue_mask)
        row = {"right_psnr_warp": metrics.psnr_tissue(warped, true, counted)}
        if scene:
            view = scene.render(frame.time, right_camera(frame.camera, eye.baseline_mm)).color.cpu().numpy()
            row["right_psnr"] = metrics.psnr_tissue(view, true, counted)
            if lpips is not None:
                row["right_lpips"] = lpips(view, true, counted)
        rows.append(row)
    context.add_frames(rows, NO_TISSUE)
