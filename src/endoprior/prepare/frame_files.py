"""Match the files of a user's mask or depth folder to the frames of the source."""

from __future__ import annotations

import re
from collections.abc import Sequence
from pathlib import Path

from ..core.checks import input_error
from ..data.files import natural_order


def match_files(
    folder: Path, suffixes: Sequence[str], what: str, indices: Sequence[int], names: Sequence[str] = ()
) -> dict[int, Path]:
    """A file for each selected frame of the source.

    With as many files as selected frames, or as images of the source folder, files are matched in natural order (2
    before 10). Otherwise they are matched by the last number in their names: to that in the names of the images if each
    of these has its own, else to positions in the source, counted from 0, or from 1 if no file has number 0.

    Args:
        folder: files of other types in it are ignored.
        suffixes: in lower case, with the dot.
        what: `masks` or `depth`, for error messages.
        indices: positions of the selected frames in the source, ascending.
        names: of all images of a source folder, without suffixes; empty for a video.
    Raises:
        InputError: no folder, no files, two files with one number, or frames without a file.
    """
    if not folder.is_dir():
        got = "a file" if folder.exists() else "no such folder"
        raise input_error(folder, f"a folder of {what}", got, "Pass the folder that holds one file per frame.")
    found = (file for file in folder.iterdir() if file.suffix.lower() in suffixes and file.name[0] != ".")
    files = sorted(found, key=natural_order)
    if not files:
        raise input_error(folder, f"{what} ({', '.join(suffixes)})", "none", "Put one file per frame there.")
    found = match_names(folder, [file.name for file in files], indices, names)
    return {index: files[position] for index, position in found.items()}


def match_names(
    folder: Path,
    files: Sequence[str],
    indices: Sequence[int],
    names: Sequence[str] = (),
    *,
    in_order_only: bool = False,
) -> dict[int, int]:
    """The position in `files` for each selected frame of the source; as `match_files`.

    Args:
        files: file names in natural order.
        in_order_only: the numbers in their names say nothing about frames.
    """
    if len(files) == len(indices):
        return dict(zip(indices, range(len(files)), strict=True))
    if len(files) == len(names):
        return {index: index for index in indices}
    counts = f"{len(files)} files for {len(indices)} frames"
    if in_order_only:
        hint = "Export one for each frame, or name each file by its frame number."
        raise input_error(folder, "masks of as many tasks as frames", counts.replace("files", "tasks"), hint)
    hint = "Add the missing files, or name each file by its frame number."
    by_number: dict[int, int] = {}
    for position, file in enumerate(files):
        if (number := _last_number(Path(file).stem)) is None:
            raise input_error(folder, "one file per frame, or numbers in the names", f"{counts}, and {file}", hint)
        if number in by_number:
            both = f"{files[by_number[number]]} and {file}"
            raise input_error(folder, "one file per frame, or one per number", f"{counts}, and {both}", hint)
        by_number[number] = position
    numbers = [_last_number(name) for name in names]
    if not numbers or None in numbers or len(set(numbers)) < len(numbers):
        first = 0 if 0 in by_number else 1
        numbers = range(first, indices[-1] + first + 1)
    missing = [str(numbers[index]) for index in indices if numbers[index] not in by_number]
    if missing:
        some = ", ".join(missing[:4]) + (f" and {len(missing) - 4} more" if len(missing) > 4 else "")
        raise input_error(folder, "one file per frame", f"{counts}, none numbered {some}", hint)
    return {index: by_number[numbers[index]] for index in indices}


def _last_number(name: str) -> int | None:
    digits = re.findall(r"[0-9]+", name)
    return int(digits[-1]) if digits else None
