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

DECIMAL = re.compile(r"[0-9]+(?:\.[0-9]+)?")
# What a file holds, by a word of its name: a mask, a depth map, or something else that is no frame.
MASK_WORDS = {
    "mask", "masks", "msk", "seg", "segm", "segmentation", "label", "labels", "annotation", "annotations", "watershed",
    "instance", "instances", "semantic", "binary", "gt", "groundtruth", "ids", "matte",
}  # fmt: skip
CONFIDENCE = "depth_confidence"  # folder with how surely the depth of each frame was measured, 8 bits
DEPTH_WORDS = {"depth", "depths", "disp", "disparity", "z"}
OTHER_WORDS = {"normal", "normals", "flow", "occlusion", "overlay", "confidence", "uncertainty", "visualization", "vis"}
IMAGE_SUFFIXES = (".png", ".jpg", ".jpeg")  # of color images that readers accept


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
        return [(m.string[: m.start()], float(m[0]), m.string[m.end() :]) for m in found]
    # Splitting at digits alternates text and number, so that equal positions always compare.
    return [[int(part) if i % 2 else part for i, part in enumerate(re.split(r"([0-9]+)", stem))] for stem in stems]


def numbers_of(stems: Sequence[str]) -> list[float] | None:
    """The number of each name: the last run of digits that differs in all, or a decimal; None if there is none."""
    if _are_decimals(stems):
        columns = [[float(DECIMAL.findall(stem)[-1]) for stem in stems]]
    else:
        rows = [[int(digits) for digits in re.findall("[0-9]+", stem)] for stem in stems]
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
    return [listed[i] for i in sorted(range(len(listed)), key=lambda i: (keys[i], listed[i].suffix))]


def files_with(folder: Path, suffixes: tuple[str, ...], ending: str = "") -> list[Path]:
    """The entries with one of the suffixes, in lower case, and such a stem, in natural order; hidden ones left out."""
    return in_order(
        file
        for file in entries(folder)
        if file.suffix.lower() in suffixes and file.stem.endswith(ending) and not file.name.startswith(".")
    )


def list_files(folder: Path, suffixes: tuple[str, ...], layout: str, ending: str = "") -> list[Path]:
    """As `files_with`; InputError if there are none. `layout` is the name of the expected layout."""
    kind = "/".join(sorted({suffix.removeprefix(".").upper() for suffix in suffixes} - {"JPEG", "TIF"}, reverse=True))
    if not folder.is_dir():
        fix = f"pass a folder in the {layout} layout."
        raise input_error(folder, f"a folder of {kind} files", "no such folder", fix)
    if files := files_with(folder, suffixes, ending):
        return files
    other = sorted({file.suffix for file in entries(folder) if file.suffix and not file.name.startswith(".")})
    got = f"none (only {', '.join(other)})" if other else "none"
    raise input_error(folder, f"{kind} files", got, f"put one {kind} per frame there.")


def read_json(
    path: Path, fix: str = "correct it or remove it.", expected: str = "a JSON object", kind: type = dict
) -> Any:
    """The object in a JSON file; of another `kind`, its list."""
    try:
        stored = json.loads(read_text(path, expected, fix))
    except InputError:
        raise
    except (ValueError, RecursionError) as error:
        raise input_error(path, expected, str(error).split("\n")[0], fix) from None
    if not isinstance(stored, kind):
        raise input_error(path, expected, type(stored).__name__, fix)
    return stored


def read_matrix(path: Path, stored: dict[str, Any], key: str, shape: tuple[int, int]) -> NDArray[np.float64]:
    """The finite matrix `key` of an object read from `path`; dots in the key go into nested objects."""
    value: Any = stored
    for part in key.split("."):
        value = value.get(part) if isinstance(value, dict) else None
    want, fix = f"{key}, {shape[0]}x{shape[1]} numbers", "process the dataset again."
    if value is None:
        raise input_error(path, want, "no such key", fix)
    try:
        matrix = np.asarray(value, np.float64)
    except (TypeError, ValueError, OverflowError):
        matrix = np.zeros(0)
    if matrix.shape != shape or not np.isfinite(matrix).all():
        raise input_error(path, want, "NaN or infinity" if matrix.shape == shape else f"shape {matrix.shape}", fix)
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
