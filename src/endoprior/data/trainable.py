"""Whether the frames of a sequence can be trained on: they show tissue, with depth, and not only white pixels."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import NamedTuple

import numpy as np

from ..core.checks import input_error
from ..core.types import Frame
from .image_folders import has_depth, how_to_add_depth
from .pixels import SATURATED, is_saturated

MIN_COLORED = 0.01  # with a smaller share of the tissue that is not saturated, there is nothing to train on


class FrameContents(NamedTuple):
    """What of a frame can be trained on."""

    tissue: float  # its share of the pixels
    has_depth: bool  # anywhere, on tools too
    num_measured: int  # tissue pixels with depth
    num_colored: int  # those of them whose color is not saturated


def frame_contents(frame: Frame) -> FrameContents:
    """What of a frame can be trained on."""
    measured = frame.depth_valid & frame.tissue_mask
    colored = measured & ~is_saturated(frame.rgb_u8)
    num_measured, num_colored = int(np.count_nonzero(measured)), int(np.count_nonzero(colored))
    return FrameContents(float(frame.tissue_mask.mean()), bool(frame.depth_valid.any()), num_measured, num_colored)


def demand_trainable(
    frames: Sequence[FrameContents], train: Sequence[int], path: Path, mask_name: str, *, is_plain: bool
) -> None:
    """Raise InputError if the frames of a sequence cannot be trained on.

    Args:
        train: indices of the training frames. path: folder of the sequence. mask_name: of the folder of masks in it.
        is_plain: whether the folder has the layout `plain`, which images without depth have, too.
    """
    masks, depth = path / mask_name, path / "depth"
    if not any(frame.tissue for frame in frames):
        hint = "the polarity may be inverted: masks are 255 on tools."
        raise input_error(masks, "tissue in at least one frame", "tool everywhere", hint)
    if not any(frame.has_depth for frame in frames):
        got = "0 everywhere" if has_depth(path) else "none"
        fix = how_to_add_depth(path, is_plain=is_plain)
        raise input_error(depth, "depth > 0 in at least one frame", got, fix)
    if not any(frames[index].num_measured for index in train):
        hint = "the mask's polarity may be inverted, or the depth may be of the tool only."
        raise input_error(depth, "depth on tissue in a training frame", "none", hint)
    share = sum(frames[index].num_colored for index in train) / sum(frames[index].num_measured for index in train)
    if share < MIN_COLORED:
        want = f"a level below {SATURATED} of 255 on at least {MIN_COLORED:.0%} of the tissue in the training frames"
        hint = "export the images again, with all values from 0 to 255 in use, or choose a darker part of the video."
        raise input_error(path, want, f"{share:.1%}: the images are white", hint)
