"""A copy of a sequence to train on, parts of which are found from its footage: its tool masks, its camera path."""

from __future__ import annotations

import hashlib
import shutil
from collections.abc import Callable
from pathlib import Path

from endoprior.core.config import DataConfig
from endoprior.data import FrameSequence, load_sequence
from endoprior.evaluation.true_masks import SCORES_FILE
from endoprior.system.atomic import whole_folder

from .estimated_poses import demand_given_path, put_estimated_path
from .found_masks import demand_masks, put_found_masks, write_scores
from .spec import SequenceSpec

KEY_DIGITS = 8


def changed_copy(
    folder: Path, chosen: SequenceSpec, sequences: Path, version: int, say: Callable[[str], None], *, write: bool
) -> FrameSequence:
    """The copy of a sequence that `masks: found` or `poses: estimated` asks for; a missing one is written.

    Args:
        folder: the sequence, which is only read. All its frames are used, at full size.
        sequences: folder of the copies.
        version: part of the name of the copy.
        say: takes a line of progress.
        write: False only looks for it.
    Raises:
        InputError: the sequence has no masks to hide or no path to compare with, or cannot be read; or `write` is
            False and there is no copy.
    """
    whole = load_sequence(folder, DataConfig(format=chosen.format, stride=1))
    if chosen.masks == "found":
        demand_masks(whole)
    if chosen.poses == "estimated":
        demand_given_path(whole)
    key = hashlib.sha256(f"{whole.fingerprint()} {version}".encode()).hexdigest()[:KEY_DIGITS]
    copy = sequences / "-".join([folder.resolve().name, *chosen.found_parts.values(), key])
    if write and not copy.is_dir():
        write_copy(whole, copy, chosen, say)
    if write and chosen.masks == "found" and not (copy / SCORES_FILE).exists():
        write_scores(whole, load_sequence(copy, DataConfig(format=chosen.format, stride=1)))
    return load_sequence(copy, DataConfig(**chosen.reading))


def write_copy(
    sequence: FrameSequence, copy: Path, chosen: SequenceSpec, say: Callable[[str], None] = lambda text: None
) -> None:
    """Copy the files of a sequence, and find the masks first: the path is estimated with them, as for a user's video.

    Args:
        sequence: all its frames.
        copy: appears when it is complete.
        say: takes a line of progress.
    Raises:
        InputError: a file cannot be used or written.
    """
    left_out = set(sequence.mask_files) if chosen.masks == "found" else set()
    with whole_folder(copy) as temporary:
        for file in set(sequence.files) - left_out:
            place = temporary / file.relative_to(sequence.path).as_posix()
            place.parent.mkdir(parents=True, exist_ok=True)
            shutil.copyfile(file, place)
        if chosen.masks == "found":
            say(f"finding tools in {len(sequence)} frames")
            put_found_masks(sequence, temporary)
        if chosen.poses == "estimated":
            say(f"following the camera through {len(sequence)} frames")
            put_estimated_path(sequence, temporary)
