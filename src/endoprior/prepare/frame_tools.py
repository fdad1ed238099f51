"""The tools of frames: found by the network, or read from the user's files; and which frames have a mask.

A network that is asked for sample frames first is not asked for them again.
"""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path

import numpy as np

from ..core.checks import input_error
from ..data.description import TOOLS_FOUND
from ..data.found_tools import FoundTools
from ..data.frame_files import match_names
from ..data.mask_files import tool_polarity
from ..data.mask_folders import open_mask_folder
from ..system.parallel import frame_threads
from .config import PrepareConfig, is_sam2
from .first_pass import FirstPass, Mask, MeasuredFrame

BYTES_PER_PIXEL = 200  # of the source: memory that a thread needs to measure a frame, bytes
COVERED = 0.5  # masks that extend over a smaller share of the frames are those of another clip, or not complete
HINT = "Check masks/, and correct them in `endoprior view` or any paint program (255 = tool)."
Tools = Callable[[MeasuredFrame], FoundTools]  # the tools of a frame; those that the user gives have confidence 1


def names_folder(masks: str) -> bool:
    """Whether a value of --masks is a folder of the user."""
    return masks not in ("auto", "none") and not is_sam2(masks)


def masked_frames(cfg: PrepareConfig, first_pass: FirstPass) -> tuple[frozenset[int], int, str] | None:
    """The frames with a mask, if there are fewer masks than frames, as in StereoMIS; None if masks decide nothing.

    Returns:
        Their positions in the source, the usual distance between them in selected frames, and a note for the user.
    """
    if not names_folder(cfg.masks):
        return None
    indices, image_names = first_pass.indices, first_pass.image_names
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
    return frozenset(found), step, f"masks: {every}{left_out}"


def choose_tools(
    cfg: PrepareConfig, first_pass: FirstPass, samples: list[MeasuredFrame]
) -> tuple[Tools, str, list[str]]:
    """A function that returns the tools of a frame, the name of its source, and notes."""
    inside = first_pass.geometry.inside
    if names_folder(cfg.masks):
        return _given_tools(cfg, first_pass, samples)
    if cfg.mask_labels:
        raise input_error("--mask-labels", "a folder with --masks", cfg.masks, "Remove --mask-labels.")
    if cfg.masks == "none":
        return lambda _frame: FoundTools(np.zeros_like(inside), 1.0), "none", []
    from ..tool_masks import ToolFinder  # imports torch

    finder = ToolFinder()
    with frame_threads(BYTES_PER_PIXEL * inside.size) as pool:
        found = list(pool.map(lambda sample: finder.find(sample.rgb_u8, inside), samples))
    known = {sample.index: each for sample, each in zip(samples, found, strict=True)}
    share = np.mean([each.mask.any() for each in found])
    source = f"{TOOLS_FOUND} in {share:.0%} of the samples" if share else f"no {TOOLS_FOUND}"
    hint = HINT if share else "Tools in view become tissue: paint them in masks/ (255 = tool), or pass --masks FOLDER."
    notes = [] if is_sam2(cfg.masks) else [f"masks: {source}. {hint}"]  # its own masks replace these
    return lambda frame: known.get(frame.index) or finder.find(frame.rgb_u8, inside), source, notes


def _given_tools(
    cfg: PrepareConfig, first_pass: FirstPass, samples: list[MeasuredFrame]
) -> tuple[Tools, str, list[str]]:
    """As `choose_tools`, from the user's files."""
    path = Path(cfg.masks)
    given = open_mask_folder(path, cfg.mask_labels)
    names = [each.name for each in given.frames]
    matched = match_names(path, names, first_pass.indices, first_pass.image_names, in_order_only=given.in_order_only)

    def high(frame: MeasuredFrame) -> Mask:
        return first_pass.frame_of(given.frames[matched.files[frame.index]].read)

    notes = [f"masks: {each}" for each in (given.note, matched.rule) if each]
    tool_is_high = given.tool_is_high
    if tool_is_high is None or cfg.mask_tool_value != "auto":
        polarity = tool_polarity(cfg.mask_tool_value, [high(f) for f in samples], [f.rgb_u8 for f in samples])
        tool_is_high = polarity.tool_is_high
        notes.append(f"masks: {polarity.reason}")
    return lambda frame: FoundTools(high(frame) == tool_is_high, 1.0), "user's files", notes
