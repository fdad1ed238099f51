"""Match the files of a mask or depth folder to frames: by their names, by the numbers in them, or in order.

Numbers come first: as many files as frames may still be of other frames, if one is missing and one is too many. Order
is used only where the numbers agree with it, or where there are none.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from ..core.checks import input_error
from .file_names import bare, numbers_of
from .files import files_with
from .series import Kind, one_per_frame

HINT = "Add the missing files, or name each file by its frame number."


@dataclass(frozen=True)
class Matched:
    """Which file belongs to which frame."""

    files: dict[int, int]
    """Position among the files, for each selected position in the source."""
    rule: str
    """How it was found, for a note: `by name`."""


def match_files(
    folder: Path, suffixes: Sequence[str], what: Kind, indices: Sequence[int], names: Sequence[str] = ()
) -> tuple[dict[int, Path], list[str]]:
    """A file for each selected frame of the source, and notes for the user; as `match_names`.

    Args:
        folder: files of other types in it are ignored.
        suffixes: in lower case, with the dot.
        what: which series is meant, if there are several.
    Raises:
        InputError: no folder, no files, several series, or frames without a file.
    """
    if not folder.is_dir():
        got = "a file" if folder.exists() else "no such folder"
        raise input_error(folder, f"a folder of {what}", got, "Pass the folder that holds one file per frame.")
    files = files_with(folder, tuple(suffixes))
    if not files:
        raise input_error(folder, f"{what} ({', '.join(suffixes)})", "none", "Put one file per frame there.")
    files, note = one_per_frame(folder, files, what)
    matched = match_names(folder, [file.name for file in files], indices, names)
    notes = [note] if note else []
    return {index: files[position] for index, position in matched.files.items()}, [*notes, f"{what}: {matched.rule}"]


def match_names(
    folder: Path,
    files: Sequence[str],
    indices: Sequence[int],
    names: Sequence[str] = (),
    *,
    in_order_only: bool = False,
) -> Matched:
    """The file of each selected frame of the source.

    Files belong to the images of their name or number, else to positions in the source, counted from 0 or from 1. With
    as many files as images or as selected frames, they are taken in order if their numbers do not contradict.

    Args:
        folder: for messages.
        files: file names in natural order.
        indices: positions of the selected frames in the source, ascending.
        names: of all images of a source folder, without suffixes; empty for a video.
        in_order_only: the numbers in the names of the files say nothing about frames.
    Raises:
        InputError: frames without a file, or names that do not tell.
    """
    counts = f"{len(files)} files for {len(indices)} frames"
    stems = [Path(file).stem for file in files]
    numbers = None if in_order_only else numbers_of(stems)
    if numbers is None:
        if by_name := _by_name(stems, indices, names):
            return Matched(by_name, "matched by name")
        return _in_order(folder, files, indices, len(names), counts, in_order_only=in_order_only)
    place = {number: position for position, number in enumerate(numbers)}
    own = numbers_of(names) if names else None
    if by_name := _by_name(stems, range(len(names)), names):
        return Matched({index: by_name[index] for index in indices}, "matched by name")
    if own is not None:
        if all(number in place for number in own):
            return Matched({index: place[own[index]] for index in indices}, "matched by the numbers in the names")
        if len(files) == len(names) and _agree(numbers, own):
            rule = f"matched in order, their numbers are counted otherwise: {files[0]} for image {names[0]}"
            return Matched({index: index for index in indices}, rule)
        if by_name := _by_name(stems, indices, names):
            return Matched(by_name, "matched by name")
        wanted = {index: own[index] for index in indices}
        if all(number in place for number in wanted.values()):
            return Matched({i: place[number] for i, number in wanted.items()}, "matched by the numbers in the names")
    else:
        fitting = [first for first in (0, 1) if all(index + first in place for index in indices)]
        # Names that begin at 1 are counted from 1; what begins later may be either.
        first = 1 if fitting == [1] or (fitting == [0, 1] and min(place) == 1) else 0
        if fitting:
            doubt = "" if fitting != [0, 1] or min(place) <= 1 else "; if they are counted from 1, number them anew"
            rule = f"matched by the numbers in the names, counted from {first}"
            files_of = {index: place[index + first] for index in indices}
            return Matched(files_of, f"{rule}: {files[files_of[indices[0]]]} for frame {indices[0]}{doubt}")
        wanted = {index: index + (0 if 0 in place else 1) for index in indices}
    chosen = [own[index] for index in indices] if own is not None else list(map(float, indices))
    if len(files) == len(indices) and _agree(numbers, chosen):
        shown = f"image {names[indices[0]]}" if names else f"frame {indices[0]}"
        rule = f"matched in order, their numbers are counted otherwise: {files[0]} for {shown}"
        return Matched(dict(zip(indices, range(len(files)), strict=True)), rule)
    missing = [f"{number:g}" for number in wanted.values() if number not in place]
    some = ", ".join(missing[:4]) + (f" and {len(missing) - 4} more" if len(missing) > 4 else "")
    raise input_error(folder, "one file per frame", f"{counts}, none numbered {some}", HINT)


def _by_name(stems: Sequence[str], indices: Sequence[int], names: Sequence[str]) -> dict[int, int] | None:
    """The file called like each image, whatever its words for mask or depth; None if there is not one for each."""
    for form in (str, bare):
        place = {form(stem): position for position, stem in enumerate(stems)}
        found = {index: place.get(form(names[index])) for index in indices} if names else {}
        if found and None not in found.values() and len(set(found.values())) == len(found):
            return found
    return None


def _agree(numbers: Sequence[float], others: Sequence[float]) -> bool:
    """Whether numbers of files in order can belong to others, one for one: all as much apart, or only counted."""
    a, b = np.array(numbers), np.array(others)
    if len(a) != len(b) or (np.diff(a) <= 0).any() or (np.diff(b) <= 0).any():
        return False
    if np.ptp(a - b) == 0:
        return True
    counted = a[0] in (0, 1) and (np.diff(a) == 1).all()
    return bool(counted and (np.ptp(np.diff(b)) == 0 or not set(numbers) & set(others)))


def _in_order(
    folder: Path, files: Sequence[str], indices: Sequence[int], total: int, counts: str, *, in_order_only: bool
) -> Matched:
    """Files without numbers, or with numbers of something else."""
    why = "their numbers are not those of frames" if in_order_only else "each has no number of its own"
    if len(files) == len(indices):
        return Matched(dict(zip(indices, range(len(files)), strict=True)), f"matched in order, {why}")
    if len(files) == total:
        return Matched({index: index for index in indices}, f"matched in order, {why}")
    if in_order_only:
        hint = "Export one for each frame, or name each file by its frame number."
        raise input_error(folder, "masks of as many tasks as frames", counts.replace("files", "tasks"), hint)
    want = "one file per frame, or a number of its own in each name"
    raise input_error(folder, want, f"{counts}, such as {files[0]} and {files[-1]}", HINT)
