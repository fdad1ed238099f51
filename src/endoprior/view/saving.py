"""Encode screenshots and videos, and store them in a folder."""

from __future__ import annotations

import tempfile
from collections.abc import Iterable
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from ..core.checks import input_error
from ..system.atomic import whole_file
from ..visualization.video import write_video


def mp4_bytes(pictures: Iterable[NDArray[np.uint8]], frames_per_second: float) -> bytes:
    """Images (H, W, 3) of one size as an H.264 video."""
    with tempfile.TemporaryDirectory() as folder:
        file = Path(folder) / "video.mp4"
        write_video(file, pictures, frames_per_second)
        return file.read_bytes()


def keep(folder: Path, name: str, content: bytes) -> Path:
    """Write a file with the first free name `stem_N.suffix` in `folder`; never overwrite a file.

    Args:
        name: a plain file name.
    Returns:
        Path of the file.
    Raises:
        ValueError: `name` contains a folder, or has no suffix.
        InputError: `folder` is a link: in an untrusted run it could point anywhere.
    """
    if folder.is_symlink():
        raise input_error(folder, "a folder", "a link to one", "Remove the link.")
    if Path(name).name != name or not Path(name).suffix:
        raise ValueError(f"name must be a plain file name with a suffix, got {name!r}")
    stem, suffix = Path(name).stem, Path(name).suffix
    number = 1
    while (file := folder / f"{stem}_{number}{suffix}").exists():
        number += 1
    with whole_file(file) as temporary:
        temporary.write_bytes(content)
    return file
