"""The right eye of a stereo endoscope: pictures that are only scored against, never trained on."""

from __future__ import annotations

from contextlib import suppress
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from ..core.checks import InputError
from .description import LEAST, MOST
from .files import IMAGE_SUFFIXES, files_with
from .frame_files import match_names
from .image_header import read_header
from .images import read_color
from .reading import read_bytes
from .shrink import shrunk_color

FOLDER = "right"
"""Name of the folder of the right images."""


class RightEye:
    """The right pictures of a rectified pair; each is decoded when it is used.

    The right camera has the lens of the left one, turned like it, and stands `baseline_mm` along its +x axis.
    """

    def __init__(self, files: list[Path], baseline_mm: float, size: tuple[int, int], shrink: int = 1) -> None:
        """Describe the pictures; nothing is decoded yet.

        Args:
            files: the right picture of each frame.
            baseline_mm: distance of the cameras, > 0.
            size: (width, height) of the files, px.
            shrink: pictures are this many times smaller than the files.
        """
        self.files, self.baseline_mm = files, baseline_mm
        self._size, self._shrink = size, shrink

    def part(self, start: int, stop: int) -> RightEye:
        """The pictures of frames `start` to `stop` - 1."""
        return RightEye(self.files[start:stop], self.baseline_mm, self._size, self._shrink)

    def image(self, index: int) -> NDArray[np.uint8]:
        """(H, W, 3) right picture of frame `index` at the size of the left one, 0..255.

        Raises:
            InputError: the file cannot be used, or has another size than the left one.
        """
        return shrunk_color(read_color(self.files[index], self._size), self._shrink)


def open_right_eye(
    path: Path,
    images: list[Path],
    kept: list[int],
    size: tuple[int, int],
    described: dict[str, Any],
    shrink: int,
    remarks: list[str],
    *,
    relative: bool,
) -> RightEye | None:
    """The right eye of a sequence folder, if it has one that can be used; else a remark says why not.

    Args:
        path: the folder; nothing is said of one without `right/`.
        images: the left picture of every frame in the folder.
        kept: positions in `images` of the frames to read.
        size: (width, height) of the left pictures, px.
        described: contents of `sequence.json`, of which `baseline_mm` is used.
        shrink: see `RightEye`.
        remarks: gets the reason, or that the files are matched in order.
        relative: whether the scale of depth is unknown: then a baseline in mm does not fit the scene.
    Raises:
        InputError: the folder or its first picture cannot be read.
    """
    folder = path / FOLDER
    if not folder.is_dir():
        return None
    files, baseline = files_with(folder, IMAGE_SUFFIXES), described.get("baseline_mm")
    reason, matched = "", None
    with suppress(InputError):
        names = [file.stem for file in images]
        matched = match_names(folder, [file.name for file in files], range(len(images)), names) if files else None
    if matched is None:
        reason = f"it has {len(files)} images, not one of the name or number of each of the {len(images)} in images/"
    elif baseline is None:
        reason = "sequence.json has no baseline_mm, the distance between the cameras"
    elif isinstance(baseline, bool) or not isinstance(baseline, int | float) or not LEAST <= baseline <= MOST:
        reason = f"baseline_mm in sequence.json is {repr(baseline)[:60]}, not a number in [{LEAST:g}, {MOST:g}]"
    elif relative:
        reason = "the scale of the depth is unknown, and the distance between the cameras is in mm"
    elif not (found := read_header(read_bytes(files[matched.files[0]]).tobytes())) or found[:2] != size:
        got = f"{found.width}x{found.height} px" if found else "no size that can be read"
        reason = f"its first image has {got}, and the left one {size[0]}x{size[1]} px"
    if reason or matched is None:
        remarks.append(f"{folder}: ignored, because {reason}")
        return None
    remarks += [f"{folder}: {matched.rule}"] if "in order" in matched.rule else []
    return RightEye([files[matched.files[i]] for i in kept], float(baseline), size, shrink)
