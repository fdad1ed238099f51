"""Read bytes and text of user files: regular files only, of bounded size."""

from __future__ import annotations

import stat
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Literal

import numpy as np
from numpy.typing import NDArray

from ..core.checks import input_error

MOST_BYTES = 1 << 30
"""Largest size of one file, also after decompression."""
MOST_PIXELS = 64_000_000
"""Most pixels of one image; 7680x4320 has half as many. `endoprior/__init__.py` tells OpenCV the same."""
MOST_TEXT_BYTES = 64 << 20
"""Largest size of a JSON, YAML or text file."""
ACCESS_HINT = "check the path and its permissions."
Kind = Literal["a file", "a folder", "nothing", "a device or a pipe"]


def kind_of(path: Path) -> Kind:
    """What is at `path`, links followed; a broken link is nothing.

    Raises:
        InputError: the name is too long, or a folder above is not readable.
    """
    try:
        mode = path.stat().st_mode
    except OSError as error:
        if isinstance(error, FileNotFoundError | NotADirectoryError) or "symbolic links" in str(error):
            return "nothing"
        raise input_error(shortened(path), "a usable path", error.strerror or str(error), ACCESS_HINT) from None
    except ValueError as error:  # a zero byte in a name that comes from a file
        raise input_error(ascii(str(path)), "a usable path", str(error), ACCESS_HINT) from None
    if stat.S_ISREG(mode):
        return "a file"
    return "a folder" if stat.S_ISDIR(mode) else "a device or a pipe"


def shortened(path: Path, most: int = 120) -> str:
    """The path as text, without its middle if it is very long."""
    text = str(path)
    return text if len(text) <= most else f"{text[: most // 2]}...{text[-most // 2 :]}"


@contextmanager
def reading(path: Path, expected: str = "a readable file", fix: str = ACCESS_HINT) -> Iterator[None]:
    """Convert errors of the system to an InputError about `path`: those of a file that is open do not name it."""
    try:
        yield
    except OSError as error:
        raise input_error(path, expected, error.strerror or str(error), fix) from None


def read_bytes(path: Path, expected: str = "a readable file", fix: str = ACCESS_HINT) -> NDArray[np.uint8]:
    """(N,) bytes of a file.

    Raises:
        InputError: missing, unreadable, not a regular file (reading a pipe could block forever), or of more than
            `MOST_BYTES`.
    """
    demand_file(path, expected, fix, MOST_BYTES)
    with reading(path, expected, fix):
        return np.fromfile(path, np.uint8)


def read_text(path: Path, expected: str, fix: str, *, or_latin_1: bool = False) -> str:
    """The text of a file in UTF-8, or in what its first bytes tell: editors on Windows write UTF-16 and a BOM.

    Args:
        or_latin_1: read other bytes as Latin-1, where only comments can have them.
    Raises:
        InputError: as `read_bytes`, up to `MOST_TEXT_BYTES`, or the bytes are no text.
    """
    demand_file(path, expected, fix, MOST_TEXT_BYTES)
    try:
        with path.open("rb") as file:
            encoding = _encoding(file.read(4))
        try:
            return path.read_text(encoding=encoding)
        except UnicodeDecodeError:
            if not or_latin_1 or encoding != "utf-8-sig":
                raise
            return path.read_text(encoding="latin-1")
    except (OSError, UnicodeError) as error:
        raise input_error(path, expected, str(error).split("\n")[0], fix) from None


def _encoding(start: bytes) -> str:
    """The encoding of a text that starts with these 4 bytes. The first character of our files is always ASCII."""
    if start.startswith((b"\xff\xfe", b"\xfe\xff")):
        return "utf-16"
    if len(start) > 1 and (start[0] == 0) != (start[1] == 0):
        return "utf-16-le" if start[0] else "utf-16-be"
    return "utf-8-sig"


def demand_file(path: Path, expected: str, fix: str, most: int = MOST_BYTES) -> None:
    """Raise InputError unless `path` is a regular file of at most `most` bytes."""
    kind = kind_of(path)
    if kind != "a file":
        raise input_error(path, expected, "No such file" if kind == "nothing" else kind, fix)
    if (size := path.stat().st_size) > most:
        raise input_error(path, f"at most {most >> 20} MB", f"{size >> 20} MB", fix)
