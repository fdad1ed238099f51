"""Masks of a data set of nerfstudio: `mask_path` of each frame in `transforms.json`.

There 0 means: do not train on this pixel. That is the inverse of ours. Masks of smaller images lie in `masks_2`,
`masks_4` and `masks_8`, beside `masks`.
"""

from __future__ import annotations

import json
from collections.abc import Callable
from pathlib import Path

from ...core.checks import InputError
from ..mask_files import read_user_mask
from ..reading import kind_of, read_text
from .frames import Mask, MaskFolder, MaskFrame, Size, sorted_frames

TRANSFORMS = "transforms.json"
SHRUNK = (2, 4, 8)


def ignore_masks(folder: Path) -> MaskFolder | None:
    """The masks that `transforms.json` names, in this folder or beside it; None if there is none or it names none."""
    for root in (folder, folder.parent):
        if kind_of(root / TRANSFORMS) == "a file" and (named := _named(root / TRANSFORMS)):
            if root != folder and not any(folder.name in _siblings(mask.parent.name) for _, mask in named):
                continue
            # A frame is known by its image; the mask usually has the same name.
            frames = sorted_frames([MaskFrame(image.name, _reader(root / mask)) for image, mask in named])
            return MaskFolder(frames, "nerfstudio masks; tools: where a mask is 0", False)
    return None


def _named(file: Path) -> list[tuple[Path, Path]]:
    """Image and mask of each frame that has a mask, as the file names them."""
    try:
        frames = json.loads(read_text(file, "a JSON file", "Write it again."))["frames"]
        return [(Path(each["file_path"]), Path(each["mask_path"])) for each in frames if each.get("mask_path")]
    except (AttributeError, KeyError, TypeError, ValueError) as error:
        if isinstance(error, InputError):
            raise
        return []


def _siblings(name: str) -> list[str]:
    """A folder of masks, and those of shrunk masks."""
    return [name, *(f"{name}_{shrunk}" for shrunk in SHRUNK)]


def _reader(mask: Path) -> Callable[[Size], Mask]:
    def read(size: Size) -> Mask:
        try:
            return read_user_mask(mask, size)
        except InputError:
            for name in _siblings(mask.parent.name)[1:]:
                other = mask.parent.with_name(name) / mask.name
                if kind_of(other) == "a file":
                    try:
                        return read_user_mask(other, size)
                    except InputError:
                        continue
            raise

    return read
