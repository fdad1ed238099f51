"""Error of the rendered depth on tissue, and its change from frame to frame. NumPy only.

`depth` and `target` are (H, W) rendered and measured z, mm, >= 0. ValueError is raised where shapes differ, a mask is
not bool, or a value at a pixel that counts is not finite floating point: ignoring it would reward broken renders.
"""

from __future__ import annotations

from itertools import pairwise
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

from ...core.checks import check_shape
from ...footage.image_operations import Mask
from ..score import Score
from .image import check_finite_float, checked_mask

if TYPE_CHECKING:
    from ..context import EvaluationContext

MIN_ALPHA = 1e-6
SCORES = (
    Score(
        "depth_rmse_mm", "depth RMSE", "mm", False, 3,
        "Root mean square error of rendered depth where depth was measured on tissue.",
        group="depth", hint="0 is exact; measured depth errs too",
    ),
    Score(
        "depth_rmse_by_alpha_mm", "depth RMSE by alpha", "mm", False, 3,
        "The same of rendered depth divided by alpha, as some methods train it: thin tissue is not too near.",
        group="depth", in_summary=False,
    ),
    Score(
        "depth_rmse_endogaussian", "depth RMSE (EndoGaussian's)", "", False, 3,
        "The depth figure of EndoGaussian's program, whose 8-bit depths wrap; only to compare with its tables.",
        group="depth", in_summary=False,
    ),
    Score(
        "depth_instability_mm", "depth instability", "mm", False, 3,
        "The published one: mean absolute change of rendered depth on tissue between adjacent frames of the video.",
        group="depth", hint="includes true motion",
    ),
)  # fmt: skip


def compute(context: EvaluationContext) -> None:
    """Score every frame of the split, and all adjacent frames of the video."""
    with context.skip_if_unavailable("depth_rmse_mm", "depth_rmse_endogaussian"):
        rows = []
        for frame in context.frames:
            depth, mask = context.rendered[frame.index].depth, frame.tissue_mask
            rmse = depth_rmse(depth, frame.depth, mask & frame.depth_valid)
            wrapped = depth_rmse_8bit(depth, frame.depth, mask, mask.size)
            rows.append({"depth_rmse_mm": rmse, "depth_rmse_endogaussian": wrapped})
        context.add_frames(rows, "no tissue with measured depth")
    with context.skip_if_unavailable("depth_rmse_by_alpha_mm"):
        values = []
        for frame in context.frames:
            out = context.scene.render(frame.time, frame.camera)
            depth = (out.depth / out.alpha.clamp(min=MIN_ALPHA)).cpu().numpy()
            values.append(depth_rmse(depth, frame.depth, frame.tissue_mask & frame.depth_valid))
        context.add_mean("depth_rmse_by_alpha_mm", values, "no tissue with measured depth")
    with context.skip_if_unavailable("depth_instability_mm"):
        values, rendered = [], context.rendered
        for a, b in pairwise(context.video):
            pair = rendered[a.index].depth, rendered[b.index].depth
            values.append(depth_instability(*pair, a.tissue_mask, b.tissue_mask))
        context.add_mean("depth_instability_mm", values, "no two adjacent frames share rendered tissue")


def depth_rmse(depth: NDArray, target: NDArray, valid: Mask) -> float:
    """Root mean square depth error over the valid pixels, mm; NaN where there is none. A hole in the rendered depth (0)
    counts as an error of the full depth. Values outside `valid` may be anything.
    """
    error = _valid_differences(depth, target, valid)
    return float(np.sqrt(np.mean(error * error))) if error.size else float("nan")


def depth_rmse_8bit(depth: NDArray, target: NDArray, counted: Mask, pixels: int) -> float:
    """A depth figure of 8-bit files, only to compare with published tables of programs that print it.

    Values, differences and squares wrap modulo 256, so a 16 mm error counts as 0 and 20 mm as sqrt(144). The sum over
    the counted pixels is divided by `pixels`: EndoGaussian counts tissue and divides by the whole frame.
    """
    _valid_differences(depth, target, counted)
    if not counted.any():
        return float("nan")
    # The remainder first: casting a float above 255 straight to uint8 is undefined, one above 2^63 to any integer.
    a, b = (np.fmod(z[counted], 256).astype(np.int64).astype(np.uint8) for z in (depth, target))
    difference = a - b
    return float(np.sqrt(np.sum(difference * difference, dtype=np.int64) / pixels))


def depth_instability(depth_a: NDArray, depth_b: NDArray, mask_a: Mask, mask_b: Mask) -> float:
    """Mean absolute change of depth between two adjacent frames, mm: the paper's depth temporal instability. A pixel
    counts where both show rendered tissue; NaN where none does. True motion counts too: compare on one sequence only.
    """
    change = _valid_differences(depth_b, depth_a, checked_mask(mask_a) & checked_mask(mask_b))
    rendered = ((depth_a > 0) & (depth_b > 0))[mask_a & mask_b]
    return float(np.abs(change)[rendered].mean()) if rendered.any() else float("nan")


def _valid_differences(depth: NDArray, target: NDArray, valid: Mask) -> NDArray[np.float64]:
    """(num_valid,) depth - target, mm, after the checks that this module promises."""
    check_shape("depth:H,W target:H,W valid:H,W", depth=depth, target=target, valid=checked_mask(valid))
    check_finite_float("depth at valid pixels", depth[valid])
    check_finite_float("target at valid pixels", target[valid])
    return depth[valid].astype(np.float64) - target[valid].astype(np.float64)
