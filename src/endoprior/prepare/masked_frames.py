"""Masks of every n-th frame only, as in StereoMIS: frames with a mask are used, those between are left out."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from ..data.file_names import numbers_of
from ..data.mask_folders import open_mask_folder
from .config import PrepareConfig
from .sam2 import is_sam2


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
    """The frames with a mask, if masks are numbered and regularly leave out frames; None if masks decide nothing.

    A few missing masks are another matter: matching reports them.

    Args:
        indices: positions in the source of the selected frames, ascending.
        image_names: of all images of a source folder, without suffixes; empty for a video.
    Raises:
        InputError: the folder of masks cannot be used.
    """
    if cfg.masks in ("auto", "none") or is_sam2(cfg.masks):
        return None
    given = open_mask_folder(Path(cfg.masks), cfg.mask_labels)
    if given.in_order_only or len(given.frames) in (len(indices), len(image_names)):
        return None
    numbers = numbers_of([Path(frame.name).stem for frame in given.frames])
    names = numbers_of(image_names)
    if numbers is None or names is None:
        return None
    first = 0 if 0 in numbers else 1
    has_mask = {*numbers}
    kept = [i for i in indices if (names[i] if names else i + first) in has_mask]
    places = np.searchsorted(indices, kept)
    step = int(np.median(np.diff(places))) if len(kept) > 1 else 1
    if step < 2:
        return None
    left_out = len(indices) - len(kept)
    note = f"masks: one for every {step} frames; {left_out} of {len(indices)} frames have none and are left out"
    return MaskedFrames(frozenset(kept), step, note)
