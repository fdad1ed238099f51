"""Masks of Label Studio, a file per region, and of nerfstudio's `transforms.json`.

Label Studio exports *Brush labels to PNG* or *NumPy*: `task-TASK-annotation-ANNOTATION-by-USER-TAG-LABEL-NUMBER.png`,
with 0 or 255. TAG is the name of the brush in the labeling interface, which the names of all files share. The name of
the image is not in the name of the file. In nerfstudio, `mask_path` of each frame is the mask, and 0 means: do not
train on this pixel. That is the inverse of ours. Masks of smaller images lie in `masks_2`, `masks_4`, `masks_8`.
"""

from __future__ import annotations

import json
import re
from collections.abc import Callable
from contextlib import suppress
from pathlib import Path

from ...core.checks import InputError
from ..files import files_with
from ..mask_files import read_user_mask
from ..reading import kind_of, read_text
from .parts import Mask, MaskFolder, MaskFrame, Size, sorted_frames, tool_labels, union_of_files, words_about

NAME = re.compile(r"task-(\d+)-annotation-(\d+)-by-([^-]*)-(.*)-(\d+)")
TRANSFORMS = "transforms.json"
SHRUNK = (2, 4, 8)


def brush_export(folder: Path, asked: str) -> MaskFolder | None:
    """The regions of each task of Label Studio, in the order of the tasks; None for a folder with other files."""
    # Of a PNG and its NumPy twin, the PNG.
    files = {file.stem: file for suffix in (".npy", ".png") for file in files_with(folder, (suffix,))}
    found = [(match, file) for stem, file in files.items() if (match := NAME.fullmatch(stem))]
    if not found:
        return None
    # Names of tags seldom have a dash, those of labels may.
    regions = [(int(m[1]), int(m[2]), m[4].partition("-")[2] or m[4], file) for m, file in found]
    labels = sorted({label for _, _, label, _ in regions})
    tools = tool_labels(folder, labels, asked)
    frames, several = [], 0
    for task in sorted({each[0] for each in regions}):
        own = [each for each in regions if each[0] == task]
        several += len({annotation for _, annotation, _, _ in own}) > 1
        frames.append(MaskFrame(f"task-{task}", union_of_files([file for *_, label, file in own if label in tools])))
    note = f"Label Studio brush labels; {words_about(labels, tools)}; tasks are matched to frames in order"
    note += f"; {several} tasks have several annotations, which are merged" if several else ""
    return MaskFolder(frames, note, True, in_order_only=True)


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
                with suppress(InputError):
                    return read_user_mask(mask.parent.with_name(name) / mask.name, size)
            raise

    return read
