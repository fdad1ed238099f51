"""Masks of some frames only, as in StereoMIS: frames with a mask are used, those between are left out."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from ..data.frame_files import match_names
from ..data.mask_folders import open_mask_folder
from .config import PrepareConfig
from .sam2 import is_sam2

COVERED = 0.5
"""Masks that extend over a smaller share of the frames are those of another clip, or not complete."""


@dataclass(frozen=True)
class MaskedFrames:
    """The frames of a clip that have a mask."""

    indices: frozenset[int]
    """Their positions in the source."""
    step: int
    """Usual distance between them, in selected frames."""
    note: str
    """A line for the user."""


def masked_frames(cfg: PrepareConfig, indices: Sequence[int], image_names: Sequence[str]) -> MaskedFrames | None:
    """The frames with a mask, if there are fewer masks than frames; None if masks decide nothing.

    Args:
        indices: positions in the source of the selected frames, ascending.
        image_names: of all images of a source folder, without suffixes; empty for a video.
    Raises:
        InputError: the folder of masks cannot be used, or its names do not tell the frames.
    """
    if cfg.masks in ("auto", "none") or is_sam2(cfg.masks):
        return None
    given = open_mask_folder(Path(cfg.masks), cfg.mask_labels)
    if given.in_order_only or len(given.frames) in (len(indices), len(image_names)):
        return None
    names = [frame.name for frame in given.frames]
    found = match_names(Path(cfg.masks), names, indices, image_names, required=()).files
    places = np.searchsorted(indices, sorted(found))
    if len(found) in (1, len(indices)) or np.ptp(places) < COVERED * (len(indices) - 1):
        return None
    step = int(np.median(np.diff(places)))
    every = f"one for every {step} frames; " if step > 1 else ""
    left_out = f"{len(indices) - len(found)} of {len(indices)} frames have none and are left out"
    return MaskedFrames(frozenset(found), step, f"masks: {every}{left_out}")
