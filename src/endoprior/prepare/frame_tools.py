"""The tools of frames: found by the network in the whole clip, or read from the user's files; which have a mask."""

from __future__ import annotations

from collections.abc import Callable, Iterable
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from ..core.checks import input_error
from ..data.found_tools import FoundTools, found_source
from ..data.frame_files import match_names
from ..data.mask_files import tool_polarity
from ..data.mask_folders import open_mask_folder
from ..system.atomic import whole_file
from ..system.console import ToDo
from ..system.parallel import frame_threads
from .config import PrepareConfig, is_sam2
from .first_pass import FirstPass, Image, Mask, MeasuredFrame

BYTES_PER_PIXEL = 200  # of the source: memory that a thread needs to measure a frame, bytes
COVERED = 0.5  # masks that extend over a smaller share of the frames are those of another clip, or not complete
HINT = "Check masks/, and correct them in `endoprior view` or any paint program (255 = tool)."
Tools = Callable[[int], FoundTools]  # the tools of a frame, by its place in the source; the user's have confidence 1
FOUND = "found_tools.npz"  # file of the work folder


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
    cfg: PrepareConfig, first_pass: FirstPass, samples: list[MeasuredFrame], every: Iterable[Image], folder: Path,
) -> tuple[Tools, str, list[str]]:  # fmt: skip
    """A function that returns the tools of a frame, the name of its source, and notes.

    Args:
        every: (H, W, 3) all frames of `first_pass.indices`, read only if tools are searched in them.
        folder: keeps what was found, so that an interrupted run need not search again.
    """
    inside = first_pass.geometry.inside
    if names_folder(cfg.masks):
        return _given_tools(cfg, first_pass, samples)
    if cfg.mask_labels:
        raise input_error("--mask-labels", "a folder with --masks", cfg.masks, "Remove --mask-labels.")
    if cfg.masks == "none":
        return lambda _index: FoundTools(np.zeros_like(inside), 1.0), "none", []
    masks, confidences = _searched(every, inside, folder / FOUND)
    places = {index: place for place, index in enumerate(first_pass.indices)}

    def tools(index: int) -> FoundTools:
        from ..tool_masks.network import full_size  # imports torch

        place = places[index]
        return FoundTools(full_size(masks[place], inside.shape) & inside, float(confidences[place]))

    share = float(masks.any((1, 2)).mean())
    source = found_source(share)
    # Where there are none, `check` warns. SAM 2's own masks replace these.
    none = f"masks: {source}. Tools in view become tissue: paint them in masks/ (255 = tool), or pass --masks FOLDER."
    note = ToDo(f"masks: {source}. {HINT}") if share else none
    return tools, source, [] if is_sam2(cfg.masks) else [note]


def _searched(every: Iterable[Image], inside: Mask, file: Path) -> tuple[NDArray[np.bool_], NDArray[np.float64]]:
    """(T, h, w) the tools of all frames at the network's size, and (T,) the confidence of each."""
    from ..tool_masks import ToolFinder  # imports torch
    from ..tool_masks.network import small_view

    if not file.is_file():
        with frame_threads(BYTES_PER_PIXEL * inside.size) as pool:
            found = list(ToolFinder().find_over_time(every, inside, pool.map))
        with whole_file(file) as temporary, temporary.open("wb") as out:
            packed = np.packbits([each.tool_mask for each in found], axis=-1)
            np.savez(out, masks=packed, confidences=[each.confidence for each in found])
    with np.load(file) as stored:
        return np.unpackbits(stored["masks"], axis=-1, count=small_view(inside).shape[1]) > 0, stored["confidences"]


def _given_tools(
    cfg: PrepareConfig, first_pass: FirstPass, samples: list[MeasuredFrame]
) -> tuple[Tools, str, list[str]]:
    """As `choose_tools`, from the user's files."""
    path = Path(cfg.masks)
    given = open_mask_folder(path, cfg.mask_labels)
    names = [each.name for each in given.frames]
    matched = match_names(path, names, first_pass.indices, first_pass.image_names, in_order_only=given.in_order_only)

    def high(index: int) -> Mask:
        return first_pass.frame_of(given.frames[matched.files[index]].read)

    notes = [f"masks: {each}" for each in (given.note, matched.rule) if each]
    tool_is_high = given.tool_is_high
    if tool_is_high is None or cfg.mask_tool_value != "auto":
        polarity = tool_polarity(cfg.mask_tool_value, [high(f.index) for f in samples], [f.rgb_u8 for f in samples])
        tool_is_high = polarity.tool_is_high
        notes.append(f"masks: {polarity.reason}")
    return lambda index: FoundTools(high(index) == tool_is_high, 1.0), "user's files", notes
