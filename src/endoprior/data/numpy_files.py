"""Arrays of .npy and .npz files: nothing in them is executed, and headers are checked against the size of the data."""

from __future__ import annotations

import io
import math
import zlib
from lzma import LZMAError
from pathlib import Path
from zipfile import BadZipFile, ZipFile

import numpy as np
from numpy.typing import NDArray

from ..core.checks import input_error
from .reading import MOST_BYTES, read_bytes

MOST_ARRAYS = 1000
"""Largest number of arrays in one .npz file."""
ZIP_START = b"PK"
_BROKEN = (OSError, ValueError, TypeError, EOFError, BadZipFile, zlib.error, LZMAError)
_UNUSUAL = (RuntimeError, MemoryError, OverflowError)  # encrypted, unknown compression, nested header


def read_numpy(path: Path, expected: str, fix: str) -> NDArray | dict[str, NDArray]:
    """The array of an .npy file, or the named arrays of an .npz file; no pickles.

    Raises:
        InputError: unreadable, not NumPy's, or larger than `MOST_BYTES`.
    """
    stored = read_bytes(path, expected, fix).tobytes()
    try:
        return _archive(stored) if stored.startswith(ZIP_START) else _array(stored)
    except (*_BROKEN, *_UNUSUAL) as error:
        problem = (str(error) or type(error).__name__).split("\n")[0][:120]
    raise input_error(path, expected, problem, fix)


def read_only_array(path: Path, fix: str) -> NDArray:
    """The array of an .npy file, or the only one of an .npz file; otherwise as `read_numpy`."""
    stored = read_numpy(path, "a NumPy file", fix)
    arrays = [stored] if isinstance(stored, np.ndarray) else list(stored.values())
    if len(arrays) != 1:
        raise input_error(path, "one array", f"{len(arrays)}", fix)
    return arrays[0]


def _archive(stored: bytes) -> dict[str, NDArray]:
    """The arrays of an .npz file; ValueError if they would be too large."""
    with ZipFile(io.BytesIO(stored)) as archive:
        members = [member for member in archive.infolist() if member.filename.endswith(".npy")]
        # Python's zipfile never decompresses a member to more than its header says.
        size = sum(member.file_size for member in members)
        if size > MOST_BYTES or len(members) > MOST_ARRAYS:
            raise ValueError(f"{len(members)} arrays of {size >> 20} MB; at most {MOST_BYTES >> 20} MB are read")
        return {member.filename.removesuffix(".npy"): _array(archive.read(member)) for member in members}


def _array(stored: bytes) -> NDArray:
    """The array in the bytes of an .npy file; ValueError or another error if they are not one."""
    file = io.BytesIO(stored)
    if not stored.startswith(np.lib.format.MAGIC_PREFIX):
        raise ValueError("pickled objects or something else" if stored else "an empty file")
    readers = {(1, 0): np.lib.format.read_array_header_1_0, (2, 0): np.lib.format.read_array_header_2_0}
    version = np.lib.format.read_magic(file)
    if version not in readers:
        raise ValueError(f"format version {version[0]}.{version[1]}")
    shape, _, dtype = readers[version](file)
    if dtype.hasobject:
        raise ValueError("pickled objects")
    if dtype.kind not in "biufcSU":
        raise ValueError(f"values of type {dtype}")
    if min(shape, default=0) < 0 or math.prod(shape) * dtype.itemsize != len(stored) - file.tell():
        raise ValueError(f"a header of shape {shape} for {len(stored) - file.tell()} bytes")
    file.seek(0)
    return np.lib.format.read_array(file, allow_pickle=False)
