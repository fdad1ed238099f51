"""PSNR and SSIM of the rendered frames."""

from __future__ import annotations

from .. import metrics
from ..context import EvaluationContext
from ..score import Score

SCORES = (
    Score(
        "psnr", "PSNR", "dB", True, 2,
        "The published one: both images are multiplied by the tissue mask, the mean squared error is over the frame.",
        "absolute", group="image", hint="as published: tools count as equal",
    ),
    Score(
        "psnr_tissue", "tissue PSNR", "dB", True, 2,
        "PSNR over the tissue pixels alone.", "absolute",
        group="image", hint="above 35 dB hard to tell from the frame",
    ),
    Score(
        "ssim", "SSIM", "", True, 4,
        "Structural similarity of the masked images over the frame.", "absolute",
        group="image", hint="1 is identical",
    ),
    Score(
        "strict_psnr", "strict PSNR", "dB", True, 2,
        "PSNR over the tissue pixels of rendered color that is not rounded to 8 bits.",
        "absolute", group="image", in_summary=False,
    ),
    Score(
        "strict_ssim", "strict SSIM", "", True, 4,
        "SSIM averaged over the tissue pixels, of rendered color that is not rounded to 8 bits.",
        "absolute", group="image", in_summary=False,
    ),
)  # fmt: skip


def compute(context: EvaluationContext) -> None:
    """Score every frame of the split."""
    rows = []
    for frame in context.frames:
        rendered, target, mask = context.rendered[frame.index], frame.rgb, frame.tissue_mask
        image = rendered.rgb
        rows.append(
            {
                "psnr": metrics.psnr(image, target, mask),
                "psnr_tissue": metrics.psnr_tissue(image, target, mask),
                "ssim": metrics.ssim(image, target, mask),
                "strict_psnr": metrics.psnr_tissue(rendered.color, target, mask),
                "strict_ssim": metrics.ssim_tissue(rendered.color, target, mask),
            }
        )
    context.add_frames(rows, "no tissue in the split")
