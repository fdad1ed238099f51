"""What the evaluation script of a paper does, as data: entry points of `endoprior.protocols` (docs/scores.md)."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal

from ...core.checks import input_error, or_did_you_mean
from ...system.plugins import Registry
from ..score import Score

DepthRule = Literal["", "mm, mean of frames", "mm, pooled", "8-bit, all pixels", "8-bit, tissue"]
ALL = "all"  # In place of a list of protocols


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
OURS = Protocol("EndoPrior-GS", "docs/scores.md", "masks", depth="mm, mean of frames")
"""The protocol of `psnr`, `ssim`, `lpips` and `depth_rmse_mm`, for tags that compare line by line."""

PROTOCOLS: Registry[Protocol] = Registry(
    "protocols",
    "an endoprior.evaluation.protocols.table.Protocol",
    lambda found: "" if isinstance(found, Protocol) else f"an object of type {type(found).__name__}",
)
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


def chosen_protocols(text: str) -> tuple[str, ...]:
    """The names in a list with commas, each once, in the order of `PROTOCOLS`; all of them for `all`."""
    names, known = [name.strip() for name in text.split(",")], PROTOCOLS.names()
    for name in names:
        if name not in (*known, ALL):
            raise input_error(
                "--protocol",
                f"{', '.join(known)} or {ALL}",
                repr(name),
                or_did_you_mean("see docs/scores.md.", name, known),
            )
    return tuple(name for name in known if ALL in names or name in names)
