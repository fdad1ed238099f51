"""Files of a dataset folder: what their names say and their order; JSON and tables of numbers."""

from __future__ import annotations

import json
import re
from collections.abc import Iterable, Sequence
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from ..core.checks import InputError, input_error
from .reading import ACCESS_HINT, read_text

NUMBER = re.compile(r"[0-9]+")
DECIMAL = re.compile(r"[0-9]+(?:\.[0-9]+)?")
MASK_WORDS = {
    "mask", "masks", "msk", "seg", "segm", "segmentation", "label", "labels", "annotation", "annotations", "watershed",
    "instance", "instances", "semantic", "binary", "gt", "groundtruth", "ids", "matte",
}  # fmt: skip
"""A file with one of these words in its name is a mask."""
DEPTH_WORDS = {"depth", "depths", "disp", "disparity", "z"}
"""A file with one of these words in its name is a depth map."""
OTHER_WORDS = {"normal", "normals", "flow", "occlusion", "overlay", "confidence", "uncertainty", "visualization", "vis"}
"""A file with one of these words in its name is no frame either."""
IMAGE_SUFFIXES = (".png", ".jpg", ".jpeg")
"""Color images that readers accept."""


def words_of(stem: str) -> set[str]:
    """The words of a name, in lower case: `frame` and `ids` of `frame_80Ids`."""
    return {word.lower() for word in re.findall(r"[A-Z]?[a-z]+|[A-Z]+", stem)}


def bare(stem: str) -> str:
    """A name without the words that say what its file shows, and what separates them."""
    roles = MASK_WORDS | DEPTH_WORDS | OTHER_WORDS
    parts = re.findall(r"[A-Z]?[a-z]+|[A-Z]+|[0-9]+|[^\W_a-zA-Z0-9]+", stem)  # and letters of other scripts
    return "_".join(part.lower() for part in parts if part.lower() not in roles)


def sorting_keys(stems: Sequence[str]) -> list[list[int | str] | tuple[str, float, str]]:
    """A key for each name, for the natural order: runs of digits are numbers, 2 before 10.

    Where the last numbers are decimals, as times in seconds are, they compare as such: 0.04 before 0.2.
    """
    if _are_decimals(stems):
        found = [list(DECIMAL.finditer(stem))[-1] for stem in stems]
        pairs = zip(stems, found, strict=True)
        return [(stem[: match.start()], float(match[0]), stem[match.end() :]) for stem, match in pairs]
    # Splitting at digits alternates text and number, so that equal positions always compare.
    split = [re.split(r"([0-9]+)", stem) for stem in stems]
    return [[int(part) if i % 2 else part for i, part in enumerate(parts)] for parts in split]


def numbers_of(stems: Sequence[str]) -> list[float] | None:
    """The number of each name, all different: the last run of digits that differs; a time in seconds as sorted.

    Returns:
        None if a name has no number, or no run of digits tells the names apart.
    """
    if _are_decimals(stems):
        columns = [[float(DECIMAL.findall(stem)[-1]) for stem in stems]]
    else:
        rows = [[int(digits) for digits in NUMBER.findall(stem)] for stem in stems]
        if not all(rows):
            return None
        even = len({len(row) for row in rows}) == 1
        columns = list(zip(*rows, strict=True))[::-1] if even else [[row[-1] for row in rows]]
    return next(([float(number) for number in column] for column in columns if len(set(column)) == len(column)), None)


def pattern_of(stem: str) -> str:
    """A name with `#` in place of each number, the same for all files of a series."""
    return DECIMAL.sub("#", stem)


def _are_decimals(stems: Sequence[str]) -> bool:
    """Whether the last numbers are decimals: as many digits behind each point say nothing, and 1.10 follows 1.9."""
    found = [DECIMAL.findall(stem) for stem in stems]
    if not all(found):
        return False
    fractions = [numbers[-1].partition(".")[2] for numbers in found]
    ends = any(len(fraction) > 1 and fraction.endswith("0") for fraction in fractions)
    return len({len(fraction) for fraction in fractions}) > 1 and not ends


def entries(folder: Path) -> list[Path]:
    """The entries of a folder, unordered."""
    try:
        return list(folder.iterdir())
    except OSError as error:
        raise input_error(folder, "a readable folder", error.strerror or str(error), ACCESS_HINT) from None


def in_order(files: Iterable[Path]) -> list[Path]:
    """The files of a folder in natural order of their names: 2 before 10, and 0.04 before 0.2 where they are times."""
    listed = list(files)
    keys = sorting_keys([file.stem for file in listed])
    pairs = zip(keys, [file.suffix for file in listed], listed, strict=True)
    return [file for _, _, file in sorted(pairs, key=lambda pair: pair[:2])]


def files_with(folder: Path, suffixes: tuple[str, ...]) -> list[Path]:
    """The entries of a folder with one of the suffixes, in natural order; hidden ones do not count."""
    usable = [file for file in entries(folder) if file.suffix.lower() in suffixes and not file.name.startswith(".")]
    return in_order(usable)


def list_files(folder: Path, suffixes: tuple[str, ...], layout: str, ending: str = "") -> list[Path]:
    """The files of a folder with one of the suffixes, in natural order; hidden ones do not count.

    Args:
        folder: where to look.
        suffixes: in lower case, with the dot.
        layout: name of the expected layout, for the message.
        ending: what the stem must end with.
    """
    kind = "/".join(sorted({suffix.removeprefix(".").upper() for suffix in suffixes} - {"JPEG", "TIF"}, reverse=True))
    if not folder.is_dir():
        fix = f"pass a folder in the {layout} layout."
        raise input_error(folder, f"a folder of {kind} files", "no such folder", fix)
    everything = [file for file in entries(folder) if not file.name.startswith(".")]
    files = [file for file in everything if file.suffix.lower() in suffixes and file.stem.endswith(ending)]
    if not files:
        other = sorted({file.suffix for file in everything if file.suffix})
        got = f"none (only {', '.join(other)})" if other else "none"
        raise input_error(folder, f"{kind} files", got, f"put one {kind} per frame there.")
    return in_order(files)


def read_json(
    path: Path, fix: str = "correct it or remove it.", expected: str = "a JSON object", kind: type = dict
) -> Any:
    """The object in a JSON file; of another `kind`, its list."""
    try:
        stored = json.loads(read_text(path, expected, fix))
    except (ValueError, RecursionError) as error:
        if isinstance(error, InputError):
            raise
        raise input_error(path, expected, str(error).split("\n")[0], fix) from None
    if not isinstance(stored, kind):
        raise input_error(path, expected, type(stored).__name__, fix)
    return stored


def read_matrix(path: Path, stored: dict[str, Any], key: str, shape: tuple[int, int]) -> NDArray[np.float64]:
    """The finite matrix `key` of an object read from `path`; dots in the key go into nested objects."""
    value: Any = stored
    for part in key.split("."):
        value = value.get(part) if isinstance(value, dict) else None
    want = f"{key}, {shape[0]}x{shape[1]} numbers"
    if value is None:
        raise input_error(path, want, "no such key", "process the dataset again.")
    try:
        matrix = np.asarray(value, np.float64)
    except (TypeError, ValueError, OverflowError):
        matrix = np.zeros(0)
    if matrix.shape != shape or not np.isfinite(matrix).all():
        got = "NaN or infinity" if matrix.shape == shape else f"shape {matrix.shape}"
        raise input_error(path, want, got, "process the dataset again.")
    return matrix


def read_table(path: Path, fix: str) -> NDArray[np.float64]:
    """(N, K) numbers of a text file, separated by commas or blanks, one row per line; '#' starts a comment."""
    lines = read_text(path, "rows of numbers", fix).splitlines()
    try:
        rows = [re.split(r"[,\s]+", line.split("#")[0].strip(", \t")) for line in lines]
        numbers = [[float(entry) for entry in row] for row in rows if row != [""]]
    except ValueError as error:
        raise input_error(path, "rows of numbers", str(error).split("\n")[0], fix) from None
    if not numbers or len({len(row) for row in numbers}) != 1:
        raise input_error(path, "rows of equally many numbers", "other rows", fix)
    return np.array(numbers)
