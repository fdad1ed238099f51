"""The facts that make two scores comparable, in the same words for every protocol: they can be read line by line."""

from __future__ import annotations

from collections.abc import Sequence

from ...model.method import method_of
from ..context import EvaluationContext
from ..rendered import SceneFrames
from .table import Protocol

KEYS = {
    "split": "split",
    "saw_test_frames": "seen in training",
    "mask_folder": "mask folder",
    "rows": "rows",
    "background": "background",
    "color": "color",
    "psnr_over": "PSNR over",
    "psnr_mean": "PSNR is",
    "ssim": "SSIM",
    "lpips": "LPIPS",
    "depth": "depth",
}
"""Tags, in order, and what tables call them."""
BACKGROUNDS = {(0.0, 0.0, 0.0): "black", (1.0, 1.0, 1.0): "white"}
NETWORKS = {"alex": "AlexNet", "vgg": "VGG16"}


def tags_of(
    protocol: Protocol, context: EvaluationContext, indices: Sequence[int], mask_folder: str, shrink: int
) -> dict[str, str]:
    """The tags of one evaluation under a protocol, by the names of `KEYS`.

    Args:
        indices: the frames that are scored.
        mask_folder: `FrameSequence.mask_folder` of the masks in use.
        shrink: what the size of the frames was divided by.
    """
    made, is_scene = context.reconstruction, isinstance(context.reconstruction, SceneFrames)
    seen, total = len({*indices} - {*context.sequence.indices("test")}), len(indices)
    height = context.sequence.camera(0).height
    kept, masked = rows_of(protocol, height, shrink)
    rows = f"0..{kept - 1} of {height}" if kept < height else f"all {height}"
    without = protocol.skips_first and 0 in context.sequence.indices(context.split)
    phase = context.sequence.test_phase
    values = {
        "split": f"{context.split}{f' {phase}/8' if phase else ''}, {total} {'without 0' if without else 'frames'}",
        "saw_test_frames": (f"yes: {seen} of {total}" if seen else "no") if is_scene else "not known",
        "mask_folder": mask_folder or "none: by the reader",
        "rows": rows + (f", {masked} masked" if masked else ""),
        "background": BACKGROUNDS[method_of(made.scene.config).background] if is_scene else "of the images",
        "color": "8 bits" if protocol.rounded else "not rounded",
        "psnr_over": "all pixels" if protocol.over_frame else "tissue pixels",
        "psnr_mean": "all frames together" if protocol.pooled else "mean of frames",
        "ssim": "complete windows" if protocol.ssim_valid else "zeros around",
        "lpips": f"{NETWORKS[protocol.lpips]}, [{protocol.lpips_lowest}, 1]",
        "depth": protocol.depth or "not scored",
    }
    return {name: values[name] for name in KEYS}


def rows_of(protocol: Protocol, height: int, shrink: int) -> tuple[int, int]:
    """How many rows from the top are scored, and how many of these at the bottom count as tool.

    Args:
        height: of a frame as it is read, px.
        shrink: what its size was divided by. Rows of the table are those of full size.
    """
    kept = min(height, protocol.kept_rows // shrink) if protocol.kept_rows else height
    return kept, min(kept, -(-protocol.masked_rows // shrink))
