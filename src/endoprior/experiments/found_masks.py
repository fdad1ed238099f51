"""A copy of a sequence whose tool masks are found from its footage, and the scores of these masks."""

from __future__ import annotations

import shutil
from collections.abc import Callable
from pathlib import Path

from ..core.checks import input_error
from ..core.config import DataConfig
from ..data import FrameSequence, load_sequence
from ..data.mask_writing import write_mask
from ..evaluation.true_masks import SCORES_FILE, TrueMasks, score_masks
from ..system.atomic import whole_folder
from ..tool_masks.sequence import find_in_sequence


def whole_sequence(folder: Path, name: str, data_format: str) -> FrameSequence:
    """All frames of a sequence at full size, as its files hold them.

    Args:
        name: of the sequence in the spec, for messages.
        data_format: layout of the folder.
    Raises:
        InputError: it cannot be read, or it has no mask files.
    """
    sequence = load_sequence(folder, DataConfig(format=data_format, stride=1))
    if not sequence.mask_files:
        want, fix = "a PNG mask per frame, to hide and to score against", "add true masks, or remove `masks: found`."
        raise input_error(f"sequences.{name}: {folder}", want, "none", fix)
    return sequence


def write_found(sequence: FrameSequence, folder: Path, progress: Callable[[str], None]) -> None:
    """Find the tools of a sequence without its masks, and write the sequence with the found masks into `folder`.

    The found masks are then scored against the sequence's own: `SCORES_FILE` in `folder`. What is there is kept.

    Args:
        sequence: as `whole_sequence` reads it; its folder is only read.
        progress: takes a line of text.
    Raises:
        InputError: a file cannot be used or written.
    """
    if not folder.is_dir():
        progress(f"finding tools in the {len(sequence)} frames of {sequence.path}")
        with whole_folder(folder) as temporary:
            places = {file: temporary / file.relative_to(sequence.path) for file in sequence.files}
            for file, place in places.items():
                place.parent.mkdir(parents=True, exist_ok=True)
                if file not in sequence.mask_files:
                    shutil.copyfile(file, place)
            found = find_in_sequence(sequence.without_masks())
            for file, (mask, _) in zip(sequence.mask_files, found, strict=True):
                write_mask(places[file], mask, sequence.mask_tool_value)
    if not (folder / SCORES_FILE).exists():
        written = load_sequence(folder, DataConfig(stride=1))
        score_masks(written, TrueMasks(sequence.path, written)).save(folder)
