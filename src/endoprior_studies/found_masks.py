"""Tool masks found from the footage of a sequence, in a copy of it; and the scores of these masks."""

from __future__ import annotations

from pathlib import Path

from endoprior.core.checks import input_error
from endoprior.data import FrameSequence
from endoprior.data.folder_edits import note_found_masks, write_mask
from endoprior.evaluation.true_masks import TrueMasks, score_masks
from endoprior.tool_masks.sequence import find_in_sequence


def demand_masks(sequence: FrameSequence) -> None:
    """Raise InputError if a sequence has no mask files, to hide and to score against."""
    if not sequence.mask_files:
        want, fix = "a PNG mask per frame, to hide and to score against", "add true masks, or remove `masks: found`."
        raise input_error(sequence.path, want, "none", fix)


def put_found_masks(sequence: FrameSequence, copy: Path) -> None:
    """Find the tools of a sequence without its masks, and write the masks into a copy of its folder that has none.

    Raises:
        InputError: a file cannot be used or written.
    """
    found, with_tools = find_in_sequence(sequence.without_masks()), 0
    for file, (mask, tools) in zip(sequence.mask_files, found, strict=True):
        place = copy / file.relative_to(sequence.path).as_posix()
        place.parent.mkdir(exist_ok=True)
        write_mask(place, mask, sequence.mask_tool_value)
        with_tools += bool(tools.mask.any())
    note_found_masks(copy, with_tools / len(sequence))


def write_scores(sequence: FrameSequence, found: FrameSequence) -> None:
    """Score the masks of the copy `found` against those of the sequence: `SCORES_FILE` in the folder of the copy."""
    score_masks(found, TrueMasks(sequence.path, found)).save(found.path)
