"""A copy of a sequence whose tool masks are found from its footage, and the scores of these masks."""

from __future__ import annotations

import shutil
from pathlib import Path

from ..core.checks import input_error
from ..core.config import DataConfig
from ..data import FrameSequence, load_sequence
from ..data.mask_writing import note_found_masks, write_mask
from ..evaluation.true_masks import TrueMasks, score_masks
from ..system.atomic import whole_folder
from ..tool_masks.sequence import find_in_sequence


def whole_sequence(folder: Path, data_format: str) -> FrameSequence:
    """All frames of a sequence at full size, as its files hold them.

    Args:
        data_format: its layout.
    Raises:
        InputError: it cannot be read, or it has no mask files.
    """
    sequence = load_sequence(folder, DataConfig(format=data_format, stride=1))
    if not sequence.mask_files:
        want, fix = "a PNG mask per frame, to hide and to score against", "add true masks, or remove `masks: found`."
        raise input_error(folder, want, "none", fix)
    return sequence


def write_found(sequence: FrameSequence, folder: Path) -> None:
    """Find the tools of a sequence without its masks, and write the sequence with the found masks into `folder`.

    Args:
        sequence: as `whole_sequence` reads it; its folder is only read.
        folder: appears when it is complete.
    Raises:
        InputError: a file cannot be used or written.
    """
    own = set(sequence.mask_files)
    with whole_folder(folder) as temporary:
        places = {file: temporary / file.relative_to(sequence.path).as_posix() for file in sequence.files}
        for file, place in places.items():
            place.parent.mkdir(parents=True, exist_ok=True)
            if file not in own:
                shutil.copyfile(file, place)
        found, with_tools = find_in_sequence(sequence.without_masks()), 0
        for file, (mask, tools) in zip(sequence.mask_files, found, strict=True):
            write_mask(places[file], mask, sequence.mask_tool_value)
            with_tools += bool(tools.mask.any())
        note_found_masks(temporary, with_tools / len(sequence))


def write_scores(sequence: FrameSequence, folder: Path, data_format: str) -> None:
    """Score the masks in `folder`, which `write_found` wrote, against those of the sequence: `SCORES_FILE` there."""
    found = whole_sequence(folder, data_format)
    score_masks(found, TrueMasks(sequence.path, found)).save(folder)
