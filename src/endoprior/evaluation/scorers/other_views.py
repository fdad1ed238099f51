"""What no training frame shows at that time: tissue behind the tool, from cameras beside, and from the right camera.

Behind the tool and from the sides the truth is that of a phantom; from cameras beside the endoscope only tissue that
it sees in the same frame counts (`phantom/views.py`). The right camera of a stereo endoscope has images of its own,
which are trained on with `data.eyes` both alone; there only tissue that both cameras see counts, by measured depth
(`data/right_camera.py`), and the left image, moved to the right camera by that depth, is scored beside the scene.
"""

from __future__ import annotations

from dataclasses import replace
from itertools import product

import numpy as np

from ...core.geometry import expected_depth, right_camera
from ...core.types import Frame
from ...data.right_camera import measured_disparity, warp_to_right
from ...footage.image_operations import Mask
from ..context import EvaluationContext
from ..score import Score
from .depth import depth_rmse
from .image import psnr_tissue
from .lpips import squeeze_distance

VEIL_SHARE = 0.05
"""Something hangs before the tissue where rendered depth is nearer than the true one by more than this share."""
FARTHEST = 20  # Turn of the cameras that are also scored by themselves, degrees; the end of their names
OF_HIDDEN = (
    Score(
        "psnr_behind_tool", "PSNR behind tool", "dB", True, 2,
        "PSNR of the pixels that the tool hides, against the true tissue; with ground truth only.",
        compare="absolute", group="image", hint="tissue that the tool hides",
    ),
    Score(
        "psnr_behind_tool_seen", "PSNR behind tool, seen", "dB", True, 2,
        "The same where a training frame shows that tissue at another time.",
        compare="absolute", group="image", in_summary=False,
    ),
    Score(
        "psnr_behind_tool_guessed", "PSNR behind tool, guessed", "dB", True, 2,
        "The same where no training frame shows that tissue.",
        compare="absolute", group="image", in_summary=False,
    ),
    Score(
        "depth_rmse_behind_tool_mm", "depth behind tool", "mm", False, 3,
        "Root mean square depth error of the pixels that the tool hides; with ground truth only.",
        group="depth", hint="tissue that the tool hides",
    ),
)  # fmt: skip
OF_SIDES = (
    Score(
        "side_psnr", "side PSNR", "dB", True, 2,
        "PSNR of tissue seen from cameras turned by 10 and 20 degrees or moved by 15 mm; with ground truth only.",
        compare="absolute", group="image", hint="the model turned",
    ),
    Score(
        "side_psnr_20", "side PSNR at 20 degrees", "dB", True, 2,
        "The same from the two cameras turned by 20 degrees.",
        compare="absolute", group="image", in_summary=False,
    ),
    Score(
        "side_lpips", "side LPIPS", "", False, 4,
        "LPIPS by SqueezeNet of these pictures, where its weights are on this machine.",
        group="image", in_summary=False,
    ),
    Score(
        "side_depth_rmse_mm", "side depth RMSE", "mm", False, 3,
        "Root mean square depth error of these pixels.",
        group="depth", in_summary=False,
    ),
    Score(
        "side_veil", "side veil", "", False, 4,
        "Share of these pixels in which rendered depth is nearer than the tissue by more than 5 %: fog and spikes.",
        compare="absolute", group="depth", in_summary=False,
    ),
)  # fmt: skip
OF_RIGHT_EYE = (
    Score(
        "right_psnr", "right eye PSNR", "dB", True, 2,
        "PSNR of tissue seen by both eyes, from the right one, not trained on but with --eyes both; stereo only.",
        compare="absolute", group="image", hint="a view never trained on",
    ),
    Score(
        "right_lpips", "right eye LPIPS", "", False, 4,
        "LPIPS by SqueezeNet of these pictures, where its weights are on this machine.",
        group="image", in_summary=False,
    ),
    Score(
        "right_psnr_warp", "right eye PSNR, warp", "dB", True, 2,
        "PSNR of these pixels in the left picture, moved to the right eye by measured depth; no scene is needed.",
        compare="absolute", group="image", in_summary=False,
    ),
)  # fmt: skip
SCORES = (*OF_HIDDEN, *OF_SIDES, *OF_RIGHT_EYE)
NO_SEEN = "not known where tissue behind the tool is seen at another time"
NO_SIDE = "no side camera sees tissue that the endoscope sees, or these frames have no side views"
NO_RIGHT = "no tissue with measured depth that both eyes see"


def compute(context: EvaluationContext) -> None:
    """Score every frame of the split that has such views."""
    for scores, part in ((OF_HIDDEN, score_hidden), (OF_SIDES, score_sides), (OF_RIGHT_EYE, score_right_eye)):
        with context.skip_if_unavailable(*(score.name for score in scores)):
            part(context)


def score_hidden(context: EvaluationContext) -> None:
    """Score what is rendered behind the tool; nothing without ground truth."""
    if (truth := context.sequence.truth) is None:
        return

    def of_tools(mask: Mask, frame: Frame) -> Mask:
        """(H, W) a mask without the border around the image and drawings over it, which masks of tools hold too."""
        over = truth.printed_over(frame.index)
        return mask if over is None else mask & ~over

    with context.skip_if_unavailable(*(score.name for score in OF_HIDDEN if score.group == "image")):
        values, seen, guessed = [], [], []
        for frame in context.frames:
            if (true_color := truth.tissue(frame.index)) is not None:
                rendered, target = context.tissue_color(frame.index), true_color / np.float32(255)
                hidden = of_tools(~frame.tissue_mask, frame)
                values.append(psnr_tissue(rendered, target, hidden))
                # The truth was written for the published split: with another one, other frames are training frames.
                shown = truth.seen(frame.index) if context.sequence.test_phase == 0 else None
                if shown is not None:
                    seen.append(psnr_tissue(rendered, target, of_tools(shown, frame)))
                    guessed.append(psnr_tissue(rendered, target, hidden & ~shown))
        context.add_mean("psnr_behind_tool", values, "no true color behind the tool")
        context.add_mean("psnr_behind_tool_seen", seen, NO_SEEN)
        context.add_mean("psnr_behind_tool_guessed", guessed, NO_SEEN)
    with context.skip_if_unavailable("depth_rmse_behind_tool_mm"):
        values = [
            depth_rmse(context.rendered[frame.index].depth, true_depth, hidden & (true_depth > 0))
            for frame in context.frames
            if (true_depth := truth.depth(frame.index)) is not None
            for hidden in [of_tools(~frame.tissue_mask, frame)]
        ]
        context.add_mean("depth_rmse_behind_tool_mm", values, "no true depth behind the tool")


def score_sides(context: EvaluationContext) -> None:
    """Score the views of cameras beside the endoscope; nothing without ground truth."""
    truth = context.sequence.truth
    if truth is None or not truth.side_poses:
        return
    lpips, scene = squeeze_distance(context, "side_lpips"), context.rendered_scene
    values: dict[str, list[float]] = {score.name: [] for score in OF_SIDES if score.name != "side_lpips" or lpips}
    for frame, (name, pose) in product(context.frames, truth.side_poses.items()):
        if (true := truth.side(name, frame.index)) is None:
            continue
        view = scene.render(frame.time, replace(frame.camera, world_to_camera=pose @ frame.camera.world_to_camera))
        color, depth, alpha = (part.cpu().numpy() for part in (view.color, view.depth, view.alpha))
        true_color, true_depth = true[0] / np.float32(255), true[1]
        counted = true_depth > 0  # tissue that the endoscope sees too
        values["side_psnr"].append(psnr_tissue(color, true_color, counted))
        if name.endswith(str(FARTHEST)):
            values["side_psnr_20"].append(values["side_psnr"][-1])
        values["side_depth_rmse_mm"].append(depth_rmse(depth, true_depth, counted))
        surface = expected_depth(depth, alpha)
        before = (surface > 0) & (surface < (1 - VEIL_SHARE) * true_depth)
        values["side_veil"].append(float(before[counted].mean()) if counted.any() else float("nan"))
        if lpips:
            values["side_lpips"].append(lpips(color, true_color, counted))
    for name, found in values.items():
        context.add_mean(name, found, NO_SIDE)


def score_right_eye(context: EvaluationContext) -> None:
    """Score the view of the right eye; nothing without one."""
    if (eye := context.sequence.right_eye) is None:
        return
    scene = None
    with context.skip_if_unavailable("right_psnr", "right_lpips"):  # rendered images: only the warp is scored
        scene = context.rendered_scene
    lpips = squeeze_distance(context, "right_lpips") if scene else None
    rows: list[dict[str, float]] = []
    for frame in context.frames:
        true = eye.image(frame.index) / np.float32(255)
        warped, counted = warp_to_right(frame.rgb, measured_disparity(frame, eye.baseline_mm), frame.tissue_mask)
        row = {"right_psnr_warp": psnr_tissue(warped, true, counted)}
        if scene:
            view = scene.render(frame.time, right_camera(frame.camera, eye.baseline_mm)).color.cpu().numpy()
            row["right_psnr"] = psnr_tissue(view, true, counted)
            if lpips:
                row["right_lpips"] = lpips(view, true, counted)
        rows.append(row)
    context.add_frames(rows, NO_RIGHT)
