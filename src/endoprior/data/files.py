"""Files of a dataset folder: list them in order, read JSON and tables of numbers."""

from __future__ import annotations

import json
import re
from collections.abc import Iterable
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from ..core.checks import InputError, input_error
from .file_names import sorting_keys
from .reading import ACCESS_HINT, read_text

IMAGE_SUFFIXES = (".png", ".jpg", ".jpeg")
"""Color images that readers accept."""


def entries(folder: Path) -> list[Path]:
    """The entries of a folder, unordered.

    Raises:
        InputError: the folder is not readable.
    """
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
    """The entries of a folder with one of the suffixes, in natural order; hidden ones do not count.

    Raises:
        InputError: the folder is not readable.
    """
    usable = [file for file in entries(folder) if file.suffix.lower() in suffixes and not file.name.startswith(".")]
    return in_order(usable)


def list_files(folder: Path, suffixes: tuple[str, ...], layout: str, ending: str = "") -> list[Path]:
    """The files of a folder with one of the suffixes, in natural order; hidden ones do not count.

    Args:
        folder: where to look.
        suffixes: in lower case, with the dot.
        layout: name of the expected layout, for the message.
        ending: what the stem must end with.
    Raises:
        InputError: no such folder, or no such file in it.
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


def read_json(path: Path, fix: str = "correct it or remove it.") -> dict[str, Any]:
    """The object in a JSON file.

    Raises:
        InputError: unreadable, not JSON, or not an object.
    """
    try:
        stored = json.loads(read_text(path, "a JSON object", fix))
    except (ValueError, RecursionError) as error:
        if isinstance(error, InputError):
            raise
        raise input_error(path, "a JSON object", str(error).split("\n")[0], fix) from None
    if not isinstance(stored, dict):
        raise input_error(path, "a JSON object", type(stored).__name__, fix)
    return stored


def read_matrix(path: Path, stored: dict[str, Any], key: str, shape: tuple[int, int]) -> NDArray[np.float64]:
    """The finite matrix `key` of an object read from `path`; dots in the key go into nested objects.

    Raises:
        InputError: missing, of another shape, or with entries that are not finite numbers.
    """
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
    """(N, K) numbers of a text file, separated by commas or blanks, one row per line; '#' starts a comment.

    Raises:
        InputError: unreadable, not numbers, or rows of different lengths.
    """
    lines = read_text(path, "rows of numbers", fix).splitlines()
    try:
        rows = [re.split(r"[,\s]+", line.split("#")[0].strip(", \t")) for line in lines]
        numbers = [[float(entry) for entry in row] for row in rows if row != [""]]
    except ValueError as error:
        raise input_error(path, "rows of numbers", str(error).split("\n")[0], fix) from None
    if not numbers or len({len(row) for row in numbers}) != 1:
        raise input_error(path, "rows of equally many numbers", "other rows", fix)
    return np.array(numbers)
