"""A copy of a sequence to train on, parts of which are found from its footage: its tool masks, its camera path."""

from __future__ import annotations

import hashlib
import shutil
from collections.abc import Callable
from pathlib import Path

import numpy as np

from endoprior.core.checks import InputError, input_error
from endoprior.core.config import DataConfig
from endoprior.data import FrameSequence, load_sequence
from endoprior.data.description import read_description
from endoprior.data.edit import BACKUP, note_found_masks
from endoprior.data.images import write_tool_mask
from endoprior.data.poses import POSES
from endoprior.evaluation.true_masks import SCORES_FILE, TrueMasks, score_masks
from endoprior.prepare.folder_path import write_folder_path
from endoprior.system.atomic import whole_folder, write_json
from endoprior.tool_masks.tool_finder import find_in_sequence

from .spec import SequenceSpec

KEY_DIGITS = 8
LENS = "as the sequence has it"
"""Source of the focal length in the copy: scores use the lens of the sequence, so that it is not refined."""


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
    reading = DataConfig(format=chosen.format, stride=1)
    whole = load_sequence(folder, reading)
    if chosen.masks == "found" and not whole.mask_files:
        want, fix = "a PNG mask per frame, to hide and to score against", "add true masks, or remove `masks: found`."
        raise input_error(whole.path, want, "none", fix)
    if chosen.poses == "estimated":
        _demand_given_path(whole)
    key = hashlib.sha256(f"{whole.fingerprint()} {version}".encode()).hexdigest()[:KEY_DIGITS]
    copy = sequences / "-".join([folder.resolve().name, *chosen.found_parts.values(), key])
    if write and not copy.is_dir():
        write_copy(whole, copy, chosen, say)
    if write and chosen.masks == "found" and not (copy / SCORES_FILE).exists():
        found = load_sequence(copy, reading)
        score_masks(found, TrueMasks(whole.path, found)).save(found.path)
    return load_sequence(copy, DataConfig(**chosen.reading))


def _demand_given_path(sequence: FrameSequence) -> None:
    """Raise InputError if a sequence has no poses to compare with, or is in no folder that can take others."""
    folder, fix = sequence.path, "remove `poses: estimated`."
    if not (folder / POSES).exists() or not all((folder / part).is_dir() for part in ("images", "masks", "depth")):
        raise input_error(folder, f"a folder with images/, masks/, depth/ and {POSES}", "another layout", fix)
    if sequence.poses_are_estimated:
        raise input_error(folder, "given poses, to compare with", f"those by {sequence.sources['poses']}", fix)
    first = sequence.camera(0).world_to_camera
    if all(np.array_equal(sequence.camera(i).world_to_camera, first) for i in range(len(sequence))):
        raise InputError(f"{folder}: the camera does not move. Fix: Remove `poses: estimated`.")


def write_copy(
    sequence: FrameSequence, copy: Path, chosen: SequenceSpec, say: Callable[[str], None] = lambda _text: None
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
            _put_found_masks(sequence, temporary)
        if chosen.poses == "estimated":
            say(f"following the camera through {len(sequence)} frames")
            _put_estimated_path(sequence, temporary)


def _put_found_masks(sequence: FrameSequence, copy: Path) -> None:
    """Find the tools of a sequence without its masks, and write the masks into a copy of its folder that has none."""
    found, with_tools = find_in_sequence(sequence.without_masks()), 0
    for file, (mask, tools) in zip(sequence.mask_files, found, strict=True):
        place = copy / file.relative_to(sequence.path).as_posix()
        place.parent.mkdir(exist_ok=True)
        write_tool_mask(place, mask, sequence.mask_tool_value)
        with_tools += bool(tools.tool_mask.any())
    note_found_masks(copy, with_tools / len(sequence))


def _put_estimated_path(sequence: FrameSequence, copy: Path) -> None:
    """Replace the poses in a copy of the folder of a sequence, as `endoprior poses` does; the old ones are removed."""
    described, camera = read_description(copy / "sequence.json"), sequence.camera(0)
    sources = sequence.sources | described.get("sources", {}) | {"lens": LENS}
    # Some layouts have these facts in files of their own.
    facts = {name: getattr(camera, name) for name in ("width", "height", "fx", "fy", "cx", "cy")}
    facts |= {"depth_relative": sequence.depth_is_relative, "sources": sources}
    write_json(copy / "sequence.json", described | facts)
    write_folder_path(copy)
    (copy / BACKUP).unlink(missing_ok=True)
