"""What the evaluation script of each paper does, as data. Explained in docs/scores.md; figures: docs/published.md.

Facts were read in the released programs at these commits: EndoNeRF 5201b1e, EndoSurf 2b33413, EndoGS 72ca45a, Endo-4DGS
39c6ce2, Deform3DGS b06f0a5, SurgicalGaussian c0ac51a; EndoGaussian at the version that scores with AlexNet.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal, get_args

from ...core.checks import input_error
from ..score import Score

ProtocolName = Literal[
    "endonerf", "endosurf", "endogs", "endo4dgs", "endogaussian", "deform3dgs", "surgicalgaussian"
]  # fmt: skip
DepthRule = Literal["", "mm, mean of frames", "mm, pooled", "8-bit, all pixels", "8-bit, tissue"]
ALL = "all"
"""In place of a list of protocols."""


@dataclass(frozen=True)
class Protocol:
    """How one script scores rendered frames."""

    title: str
    """Name of the method."""
    source: str
    """Which paper and which file."""
    masks: Literal["masks", "gt_masks", "gt_masks, else masks"]
    """Folder of the tool masks. Without its own folder, a protocol of `gt_masks` alone has no scores."""
    skips_first: bool = False
    """Whether frame 0 is left out."""
    kept_rows: int = 0
    """Rows from the top that are kept, of a frame of full size; 0 keeps all."""
    masked_rows: int = 0
    """Rows at the bottom, of a frame of full size, that count as tool."""
    rounded: bool = True
    """Whether rendered color goes through 8-bit files."""
    over_frame: bool = True
    """Whether the squared error is divided by all pixels of the frame, rather than by those of tissue."""
    pooled: bool = False
    """Whether PSNR is computed once, from the squared errors of all frames, rather than as a mean of frames."""
    ssim_valid: bool = False
    """Whether SSIM uses complete windows only, rather than zeros around the frame."""
    lpips: Literal["alex", "vgg"] = "alex"
    """Classifier of LPIPS."""
    lpips_lowest: Literal[-1, 0] = -1
    """Value of black that it sees: the calibrated range is [-1, 1]."""
    depth: DepthRule = ""
    """Rule of the depth error; empty: the script has none that is published."""
    paper: tuple[tuple[str, str], ...] = ()
    """Tags of the published figures where they cannot be repeated here: by tag, what the paper did."""
    differs: tuple[str, ...] = ()
    """What is computed here in another way than by the script, one sentence each."""


OURS = Protocol("EndoPrior-GS", "docs/scores.md", "masks", depth="mm, mean of frames")
"""The protocol of `psnr`, `ssim`, `lpips` and `depth_rmse_mm`, for tags that compare line by line."""

SEEN = (("split", "all frames but the first"), ("saw_test_frames", "yes: all of them"))
HELD_OUT = (("split", "test, the same rule"),)

PROTOCOLS: dict[ProtocolName, Protocol] = {
    "endonerf": Protocol(
        "EndoNeRF",
        "Wang et al., MICCAI 2022; eval_rgb.py",
        masks="gt_masks, else masks",
        skips_first=True,
        pooled=True,
        lpips_lowest=0,
        paper=(*SEEN, ("background", "none: a radiance field")),
        differs=(
            "The script takes the mask folder as an argument; the command in its README names gt_masks.",
            "How that program rounds color to 8 bits was not established; here to the nearest value.",
        ),
    ),
    "endosurf": Protocol(
        "EndoSurf",
        "Zha et al., MICCAI 2023; src/trainer/utils.py",
        masks="masks",
        rounded=False,
        over_frame=False,
        pooled=True,
        ssim_valid=True,
        lpips="vgg",
        depth="mm, pooled",
        paper=(*HELD_OUT, ("saw_test_frames", "by the bounding sphere"), ("background", "none: a radiance field")),
        differs=(
            "Depth is scored wherever it is measured on tissue; the script also drops percentiles of the whole video.",
            "LPIPS is the mean of frames; the script averages pairs, so the last of an odd number counts twice.",
        ),
    ),
    "endogs": Protocol(
        "EndoGS",
        "Zhu et al., arXiv 2401.11535; eval_rgb.py",
        masks="gt_masks, else masks",
        skips_first=True,
        kept_rows=500,
        over_frame=False,
        pooled=True,
        lpips_lowest=0,
        paper=(*SEEN, ("background", "white")),
    ),
    "endo4dgs": Protocol(
        "Endo-4DGS",
        "Huang et al., MICCAI 2024; metrics.py",
        masks="masks",
        lpips_lowest=0,
        paper=(*HELD_OUT, ("saw_test_frames", "no"), ("background", "black")),
    ),
    "endogaussian": Protocol(
        "EndoGaussian",
        "Liu et al., arXiv 2401.12561; metrics.py",
        masks="masks",
        depth="8-bit, all pixels",
        paper=(*HELD_OUT, ("saw_test_frames", "no"), ("background", "black")),
    ),
    "deform3dgs": Protocol(
        "Deform3DGS",
        "Yang et al., MICCAI 2024; metrics.py",
        masks="masks",
        depth="8-bit, tissue",
        paper=(*HELD_OUT, ("saw_test_frames", "by the initialization"), ("background", "black")),
    ),
    "surgicalgaussian": Protocol(
        "SurgicalGaussian",
        "Xie et al., MICCAI 2024; metrics.py",
        masks="gt_masks",
        masked_rows=12,
        lpips_lowest=0,
        paper=(*HELD_OUT, ("saw_test_frames", "by the initialization"), ("background", "white")),
        differs=("Its depth figures (of scaled depth, and of depth divided by 100) are not computed.",),
    ),
}  # fmt: skip
"""By the name that `--protocol` takes."""

SCORES: dict[str, Score] = {
    score.name: score
    for score in (
        Score("psnr", "PSNR", "dB", True, 2, "PSNR by the rule of the protocol.", "absolute", group="image"),
        Score("ssim", "SSIM", "", True, 4, "SSIM by the rule of the protocol.", "absolute", group="image"),
        Score("lpips", "LPIPS", "", False, 4, "LPIPS with the network and range of the protocol.", group="image"),
        Score("depth_rmse_mm", "depth RMSE", "mm", False, 3, "Depth error on tissue.", group="depth"),
        Score("depth_rmse_8bit", "8-bit depth", "", False, 3, "Wraps modulo 256: no error.", group="depth"),
    )
}
"""Scores of a protocol by name. They never stand beside ours: the same name may mean another number."""


def chosen_protocols(text: str) -> tuple[ProtocolName, ...]:
    """The names in a list with commas, each once, in the order of `PROTOCOLS`; all of them for `all`.

    Raises:
        InputError: an empty or unknown name.
    """
    names = [name.strip() for name in text.split(",")]
    known = get_args(ProtocolName)
    for name in names:
        if name not in (*known, ALL):
            raise input_error("--protocol", f"{', '.join(known)} or {ALL}", repr(name), "see docs/scores.md.")
    return tuple(name for name in known if ALL in names or name in names)
