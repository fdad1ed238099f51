"""The scene as cameras beside the endoscope see it, against the tissue that is really there; needs ground truth.

Only tissue that the endoscope sees in the same frame counts (`phantom/side_views.py`).
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from ...core.geometry import expected_depth
from .. import metrics
from ..context import EvaluationContext
from ..score import Score
from .lpips import squeeze_distance

VEIL_SHARE = 0.05
"""Something hangs before the tissue where rendered depth is nearer than the true one by more than this share."""
FARTHEST = 20
"""Turn of the cameras that are also scored by themselves, degrees; the end of their names."""
SCORES = (
    Score(
        "side_psnr", "side PSNR", "dB", True, 2,
        "PSNR of tissue seen from cameras turned by 10 and 20 degrees or moved by 15 mm; with ground truth only.",
        "absolute", group="image", hint="the model turned",
    ),
    Score(
        "side_psnr_20", "side PSNR at 20 degrees", "dB", True, 2,
        "The same from the two cameras turned by 20 degrees.",
        "absolute", group="image", in_summary=False,
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
        "absolute", group="depth", in_summary=False,
    ),
)  # fmt: skip
NO_TISSUE = "no side camera sees tissue that the endoscope sees, or these frames have no side views"


@dataclass(frozen=True)
class SidePair:
    """One side camera in one frame: rendered and true."""

    name: str
    rgb: NDArray[np.float32]
    """(H, W, 3) in [0, 1]."""
    depth: NDArray[np.float32]
    """(H, W) mm."""
    surface: NDArray[np.float32]
    """(H, W) depth divided by the accumulated opacity, mm; 0 where nothing is rendered."""
    true_rgb: NDArray[np.float32]
    """(H, W, 3) in [0, 1], 0 where the pixel does not count."""
    true_depth: NDArray[np.float32]
    """(H, W) mm, 0 where the pixel does not count."""

    @property
    def counted(self) -> NDArray[np.bool_]:
        """(H, W) tissue that the endoscope sees too."""
        return self.true_depth > 0


def compute(context: EvaluationContext) -> None:
    """Score every frame of the split that has side views; nothing without ground truth."""
    truth = context.sequence.truth
    if truth is None or not truth.side_poses:
        return
    with context.skip_if_unavailable(*(score.name for score in SCORES)):
        lpips = squeeze_distance(context, "side_lpips")
        names = [score.name for score in SCORES if score.name != "side_lpips" or lpips is not None]
        values: dict[str, list[float]] = {name: [] for name in names}
        for pair in _pairs(context):  # one after the other: the pictures of a long sequence do not fit in memory
            psnr = metrics.psnr_tissue(pair.rgb, pair.true_rgb, pair.counted)
            values["side_psnr"].append(psnr)
            if pair.name.endswith(str(FARTHEST)):
                values["side_psnr_20"].append(psnr)
            values["side_depth_rmse_mm"].append(metrics.depth_rmse(pair.depth, pair.true_depth, pair.counted))
            values["side_veil"].append(veil(pair))
            if lpips is not None:
                values["side_lpips"].append(lpips(pair.rgb, pair.true_rgb, pair.counted))
        for name, found in values.items():
            context.add_mean(name, found, NO_TISSUE)


def veil(pair: SidePair) -> float:
    """Share of the pixels that count before which something hangs; NaN without such pixels."""
    before = (pair.surface > 0) & (pair.surface < (1 - VEIL_SHARE) * pair.true_depth)
    return float(before[pair.counted].mean()) if pair.counted.any() else float("nan")


def _pairs(context: EvaluationContext) -> Iterator[SidePair]:
    """Every side camera in every frame of the split that has its truth."""
    truth, scene = context.sequence.truth, context.rendered_scene
    for frame in context.frames:
        for name, pose in truth.side_poses.items():
            if (true := truth.side(name, frame.index)) is None:
                continue
            camera = replace(frame.camera, world_to_camera=pose @ frame.camera.world_to_camera)
            view = scene.render(frame.time, camera)
            depth, alpha = view.depth.cpu().numpy(), view.alpha.cpu().numpy()
            yield SidePair(
                name,
                view.color.cpu().numpy(),
                depth,
                expected_depth(depth, alpha),
                true[0] / np.float32(255),
                true[1],
            )
