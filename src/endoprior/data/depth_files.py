"""Read depth or disparity files: PNG, TIFF, NumPy, EXR."""

from __future__ import annotations

from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from ..core.checks import input_error
from ..core.shell import install_command
from .depth_fill import is_measured
from .images import decode_image, single_channel
from .numpy_files import read_only_array
from .reading import MOST_PIXELS, demand_file

DEPTH_SUFFIXES = (".png", ".npy", ".npz", ".tiff", ".tif", ".exr")
"""Suffixes of the files this module reads, in lower case."""


def read_depth_file(
    path: Path, mm_per_unit: float = 1.0, size: tuple[int, int] | None = None, *, relative: bool = False
) -> NDArray[np.float32]:
    """Read a depth image.

    Args:
        path: PNG or TIFF (8 or 16 bit, TIFF also float), NPY, NPZ with one array, or EXR with one channel.
        mm_per_unit: mm per stored unit.
        size: (width, height) it must have, px; None accepts any.
        relative: the depth is only scaled, see `is_measured`.
    Returns:
        (H, W) depth, mm; 0 where it is missing (`is_measured`).
    Raises:
        InputError: unreadable, of another size or kind, or EXR without the OpenEXR package.
    """
    stored = read_stored(path, size)
    depth = _as_float32(stored) * np.float32(mm_per_unit)
    return np.where(is_measured(stored, relative=relative) & np.isfinite(depth), depth, np.float32(0))


def read_values(path: Path, size: tuple[int, int] | None = None) -> NDArray[np.float32]:
    """(H, W) numbers of a one-channel file, none of them missing; kinds, `size` and errors as `read_depth_file`."""
    return _as_float32(read_stored(path, size))


def read_stored(path: Path, size: tuple[int, int] | None = None) -> NDArray:
    """(H, W) numbers of a one-channel file in their own type; kinds, `size` and errors as `read_depth_file`."""
    suffix = path.suffix.lower()
    if suffix not in DEPTH_SUFFIXES:
        raise input_error(path, f"one of {', '.join(DEPTH_SUFFIXES)}", suffix or "no suffix", "convert the file.")
    if suffix in (".npy", ".npz"):
        pixels = _read_numpy(path)
    elif suffix == ".exr":
        pixels = _read_exr(path)
    else:
        pixels = single_channel(path, decode_image(path, size))
    if pixels.dtype.kind not in "iuf":
        raise input_error(path, "integers or floats", str(pixels.dtype), "save it as float or 16-bit.")
    if size is not None and pixels.shape != (size[1], size[0]):
        got = f"{pixels.shape[1]}x{pixels.shape[0]}"
        raise input_error(path, f"{size[0]}x{size[1]} px like the first image", got, "bring all files to one size.")
    return pixels


def _as_float32(stored: NDArray) -> NDArray[np.float32]:
    with np.errstate(over="ignore"):  # a float64 beyond float32 becomes infinity, which is missing
        return stored.astype(np.float32)


def _read_numpy(path: Path) -> NDArray:
    """The (H, W) array of an .npy file, or of an .npz file that holds nothing else; no pickles.

    Axes of length 1 in front of the others or behind them are dropped.
    """
    hint = "write it again with numpy.save."
    array = read_only_array(path, hint)
    while array.ndim > 2 and 1 in (array.shape[0], array.shape[-1]):
        array = array[0] if array.shape[0] == 1 else array[..., 0]
    if array.ndim != 2:
        raise input_error(path, "an array of shape (H, W)", f"shape {array.shape}", hint)
    return array


def _read_exr(path: Path) -> NDArray:
    """The (H, W) channel of an EXR file: its only one, `Z`, or several that are equal."""
    try:
        import OpenEXR  # optional: the packages of OpenCV have no EXR decoder
    except ImportError:
        raise input_error(path, "the OpenEXR package", "none", f"`{install_command('exr')}`.") from None
    demand_file(path, "an EXR image", "write the file again.")
    try:
        with OpenEXR.File(str(path), header_only=True) as file:
            (left, top), (right, bottom) = (np.asarray(corner, int).tolist() for corner in file.header()["dataWindow"])
        if (right - left + 1) * (bottom - top + 1) > MOST_PIXELS:
            raise ValueError(f"{right - left + 1}x{bottom - top + 1} px by its header")
        with OpenEXR.File(str(path), separate_channels=True) as file:
            channels = {name: np.array(channel.pixels) for name, channel in file.channels().items()}
    except Exception as error:  # the library raises many kinds, RuntimeError among them
        raise input_error(path, "an EXR image", str(error).split("\n")[0], "write the file again.") from None
    if "Z" in channels:
        return channels["Z"]
    first, *others = [channels[name] for name in channels if name != "A"] or [None]
    if first is None or any(not np.array_equal(first, other, equal_nan=True) for other in others):
        hint = "save depth alone, as channel Z."
        raise input_error(path, "one channel, or one called Z", ", ".join(channels) or "none", hint)
    return first
