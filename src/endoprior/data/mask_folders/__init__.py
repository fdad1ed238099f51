"""Recognize a folder of masks by its files: SAM 2, CVAT, Label Studio, nerfstudio, or one plain file per frame.

Label Studio exports *Brush labels to PNG* or *NumPy*: `task-TASK-annotation-ANNOTATION-by-USER-TAG-LABEL-NUMBER.png`,
with 0 or 255. TAG is the name of the brush in the labeling interface, which the names of all files share. The name of
the image is not in the name of the file. In nerfstudio, `mask_path` of each frame of `transforms.json` is the mask, and
0 means: do not train on this pixel. That is the inverse of ours. Masks of smaller images lie in `masks_2` and so on.
"""

from __future__ import annotations

import json
import re
from collections.abc import Callable
from contextlib import suppress
from pathlib import Path

from ...core.checks import InputError, input_error
from ..files import entries, files_with, in_order, named_file, portable
from ..frame_files import one_per_frame
from ..images import Size
from ..mask_files import MASK_SUFFIXES, OPTION, Mask, demand_known, name, read_user_mask, rule_of_files
from ..reading import kind_of, read_text
from .cvat import segmentation_masks, xml_annotations
from .parts import MaskFolder, MaskFrame, sorted_frames, tool_labels, union_of_files, words_about
from .sam2 import object_folders, palette_folder, sav_file

__all__ = ["MaskFolder", "MaskFrame", "open_mask_folder"]

NAME = re.compile(r"task-(\d+)-annotation-(\d+)-by-([^-]*)-(.*)-(\d+)")
TRANSFORMS = "transforms.json"


def open_mask_folder(path: Path, labels: str = "") -> MaskFolder:
    """The masks of a user, by frame. Nothing is decoded yet.

    Args:
        path: a folder, or the XML of CVAT or the JSON of SA-V.
        labels: names of the labels that are tools, separated by commas; empty to tell by their names.
    """
    kind = kind_of(path)
    if kind == "a folder":
        return _in_folder(path, labels)
    if kind == "a file" and (found := _in_file(path, labels)):
        return found
    got, fix = "a file" if kind == "a file" else "no such folder", "Pass the folder that holds one file per frame."
    raise input_error(path, "a folder of masks, CVAT's XML or SA-V's JSON", got, fix)


def _in_file(file: Path, labels: str) -> MaskFolder | None:
    """The masks in an XML or JSON file; None if it holds something else."""
    reader = {".xml": xml_annotations, ".json": sav_file}.get(file.suffix.lower())
    return reader(file, labels) if reader else None


def _in_folder(folder: Path, labels: str) -> MaskFolder:
    for reader in (segmentation_masks, _brush_export, _ignore_masks, palette_folder, object_folders):
        if found := reader(folder, labels):
            return found
    if files := files_with(folder, MASK_SUFFIXES):
        return _plain(folder, files, labels)
    read = [(file, found) for file in files_with(folder, (".xml", ".json")) if (found := _in_file(file, labels))]
    if len(read) > 1:
        names = ", ".join(file.name for file, _ in read)
        raise input_error(folder, "one file with annotations", names, f"Pass one of them, such as {read[0][0]}.")
    if read:
        return read[0][1]
    inner = in_order(each for each in entries(folder) if each.is_dir() and each.name[0] != ".")
    # SAM 2 writes a folder per video.
    with_masks = [each for each in inner if files_with(each, MASK_SUFFIXES) or object_folders(each, "")]
    if len(with_masks) > 1:
        names = ", ".join(each.name for each in with_masks[:4])
        raise input_error(folder, "the masks of one video", f"the folders {names}", f"Pass {with_masks[0]}.")
    if with_masks:
        return _in_folder(with_masks[0], labels)
    raise input_error(folder, f"masks ({', '.join(MASK_SUFFIXES)})", "none", "Put one file per frame there.")


def _plain(folder: Path, files: list[Path], labels: str) -> MaskFolder:
    """One file per frame; labels in them are tools where their values or the user tell."""
    files, left_out = one_per_frame(folder, files, "masks")
    rule = rule_of_files(files, labels)
    example = name(rule.labels[-1]) if rule.labels else ""
    demand_known(folder, rule, f"name those of tools, such as `{OPTION} {example}`.")
    frames = [MaskFrame(file.name, union_of_files([file], rule)) for file in files]
    hint = f"; others: `{OPTION} {example}`" if rule.labels and not labels else ""
    note = "; ".join(each for each in (left_out, rule.note + hint) if each)
    return MaskFolder(frames, note, True if rule.labels else None)


def _brush_export(folder: Path, asked: str) -> MaskFolder | None:
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


def _ignore_masks(folder: Path, asked: str) -> MaskFolder | None:
    """The masks that `transforms.json` names, in this folder or beside it; None if there is none or it names none."""
    for root in (folder, folder.parent):
        named = _named(root / TRANSFORMS) if kind_of(root / TRANSFORMS) == "a file" else []
        if not named or (root != folder and not any(folder.name in _siblings(mask.parent.name) for _, mask in named)):
            continue
        if asked:
            raise input_error(OPTION, "masks with labels", "masks of one kind", f"Remove {OPTION}.")
        # A frame is known by its image; the mask usually has the same name.
        frames = sorted_frames([MaskFrame(image.name, _reader(mask)) for image, mask in named])
        return MaskFolder(frames, "nerfstudio masks; tools: where a mask is 0", False)
    return None


def _named(file: Path) -> list[tuple[Path, Path]]:
    """Image and mask of each frame that has a mask, as the file names them."""
    text = read_text(file, "a JSON file", "Write it again.")
    try:
        frames = json.loads(text)["frames"]
        pairs = [(each["file_path"], each["mask_path"]) for each in frames if each.get("mask_path")]
        return [(Path(portable(image)), named_file(file.parent, mask)) for image, mask in pairs]
    except (AttributeError, KeyError, TypeError, ValueError, RecursionError):
        return []


def _siblings(name: str) -> list[str]:
    """A folder of masks, and those of shrunk masks."""
    return [name, f"{name}_2", f"{name}_4", f"{name}_8"]


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
