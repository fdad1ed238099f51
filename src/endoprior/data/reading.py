"""The bytes and texts of a user's files: regular files only, and never more than a file of its kind can need."""

from __future__ import annotations

import stat
from pathlib import Path
from typing import Literal

import numpy as np
from numpy.typing import NDArray

from ..core.checks import InputError

MOST_BYTES = 1 << 30
"""Of one file, and of what one compressed file may unfold to."""
MOST_TEXT_BYTES = 64 << 20
"""Of a JSON, YAML or text file."""
ACCESS_HINT = "Check the path and the rights."
Kind = Literal["a file", "a folder", "nothing", "a device or a pipe"]


def complaint(path: Path | str, expected: str, got: str, next_step: str) -> InputError:
    """The error for a file or folder that cannot be used, on one line."""
    return InputError(f"{path}: expected {expected}; got {got}. {next_step}")


def kind_of(path: Path) -> Kind:
    """What is at `path`, links followed; a link that leads nowhere, or to itself, is nothing.

    Raises:
        InputError: the system does not say, because the name is too long or a folder above is closed to the user.
    """
    try:
        mode = path.stat().st_mode
    except OSError as error:
        if isinstance(error, FileNotFoundError | NotADirectoryError) or "symbolic links" in str(error):
            return "nothing"
        raise complaint(shortened(path), "a usable path", error.strerror or str(error), ACCESS_HINT) from None
    except ValueError as error:  # a zero byte in a name that came out of a file
        raise complaint(ascii(str(path)), "a usable path", str(error), ACCESS_HINT) from None
    if stat.S_ISREG(mode):
        return "a file"
    return "a folder" if stat.S_ISDIR(mode) else "a device or a pipe"


def shortened(path: Path, most: int = 120) -> str:
    """The path as text, its middle left out where it is very long."""
    text = str(path)
    return text if len(text) <= most else f"{text[: most // 2]}...{text[-most // 2 :]}"


def read_bytes(path: Path, expected: str = "a readable file", next_step: str = ACCESS_HINT) -> NDArray[np.uint8]:
    """(N,) bytes of a file.

    Raises:
        InputError: missing, unreadable, not a regular file (reading a pipe would wait for ever), or of more than
            `MOST_BYTES`; `expected` says what should be there.
    """
    demand_file(path, expected, next_step, MOST_BYTES)
    try:
        return np.fromfile(path, np.uint8)
    except OSError as error:
        raise complaint(path, expected, error.strerror or str(error), next_step) from None


def read_text(path: Path, expected: str, next_step: str) -> str:
    """The text of a UTF-8 file; as `read_bytes`, up to `MOST_TEXT_BYTES`."""
    demand_file(path, expected, next_step, MOST_TEXT_BYTES)
    try:
        return path.read_text(encoding="utf-8")
    except (OSError, UnicodeDecodeError) as error:
        raise complaint(path, expected, str(error).split("\n")[0], next_step) from None


def demand_file(path: Path, expected: str, next_step: str, most: int = MOST_BYTES) -> None:
    """Refuse what is not a regular file, and more than `most` bytes."""
    kind = kind_of(path)
    if kind != "a file":
        raise complaint(path, expected, "No such file" if kind == "nothing" else kind, next_step)
    if (size := path.stat().st_size) > most:
        raise complaint(path, f"at most {most >> 20} MB", f"{size >> 20} MB", next_step)
