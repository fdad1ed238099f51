"""Match the files of a user's mask or depth folder to the frames of the source."""

from __future__ import annotations

import re
from collections.abc import Sequence
from pathlib import Path

from ..core.checks import input_error
from ..data.files import natural_order


def match_files(folder: Path, suffixes: Sequence[str], what: str, indices: Sequence[int]) -> dict[int, Path]:
    """A file for each selected frame of the source.

    With as many files as frames, files are matched in natural order (2 before 10). Otherwise they are matched by the
    last number in their names, counted from 0, or from 1 if no file has number 0. The selection may then be a part of
    the frames that the folder covers.

    Args:
        folder: files of other types in it are ignored.
        suffixes: in lower case, with the dot.
        what: `masks` or `depth`, for error messages.
        indices: positions of the selected frames in the source, ascending.
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
    if len(files) == len(indices):
        return dict(zip(indices, files, strict=True))
    counts = f"{len(files)} files for {len(indices)} frames"
    hint = "Add the missing files, or name each file by its frame number."
    by_number: dict[int, Path] = {}
    for file in files:
        digits = re.findall(r"[0-9]+", file.stem)
        if not digits:
            raise input_error(folder, "one file per frame, or numbers in the names", f"{counts}, and {file.name}", hint)
        if (number := int(digits[-1])) in by_number:
            both = f"{by_number[number].name} and {file.name}"
            raise input_error(folder, "one file per frame, or one per number", f"{counts}, and {both}", hint)
        by_number[number] = file
    first = 0 if 0 in by_number else 1
    missing = [str(index + first) for index in indices if index + first not in by_number]
    if missing:
        some = ", ".join(missing[:4]) + (f" and {len(missing) - 4} more" if len(missing) > 4 else "")
        raise input_error(folder, "one file per frame", f"{counts}, none numbered {some}", hint)
    return {index: by_number[index + first] for index in indices}
