"""Recognize a folder of masks by its files: SAM 2, CVAT, Label Studio, nerfstudio, or one plain file per frame."""

from __future__ import annotations

from pathlib import Path

from ...core.checks import input_error
from ..files import entries, files_with, in_order
from ..frame_files import one_per_frame
from ..mask_files import MASK_SUFFIXES, demand_known, name, rule_of_files
from ..reading import kind_of
from .cvat import annotations, segmentation_masks
from .others import brush_export, ignore_masks
from .parts import OPTION, MaskFolder, MaskFrame, union_of_files
from .sam2 import object_folders, palette_folder, sav_file

__all__ = ["MaskFolder", "MaskFrame", "open_mask_folder"]


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


def _in_folder(folder: Path, labels: str) -> MaskFolder:
    if found := segmentation_masks(folder, labels) or brush_export(folder, labels):
        return found
    if found := ignore_masks(folder):
        if labels:
            raise input_error(OPTION, "masks with labels", "masks of one kind", f"Remove {OPTION}.")
        return found
    if found := palette_folder(folder, labels) or object_folders(folder, labels):
        return found
    files = files_with(folder, MASK_SUFFIXES)
    if not files:
        documents = files_with(folder, (".xml", ".json"))
        read = [(file, found) for file in documents if (found := _in_file(file, labels))]
        if len(read) > 1:
            names = ", ".join(file.name for file, _ in read)
            raise input_error(folder, "one file with annotations", names, f"Pass one of them, such as {read[0][0]}.")
        if read:
            return read[0][1]
        inner = in_order(each for each in entries(folder) if each.is_dir() and each.name[0] != ".")
        # SAM 2 writes a folder per video.
        with_masks = [each for each in inner if files_with(each, MASK_SUFFIXES) or object_folders(each, "")]
        if len(with_masks) == 1:
            return _in_folder(with_masks[0], labels)
        if with_masks:
            names = ", ".join(each.name for each in with_masks[:4])
            raise input_error(folder, "the masks of one video", f"the folders {names}", f"Pass {with_masks[0]}.")
    if not files:
        fix = "Put one file per frame there."
        raise input_error(folder, f"masks ({', '.join(MASK_SUFFIXES)})", "none", fix)
    return _plain(folder, files, labels)


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


def _in_file(file: Path, labels: str) -> MaskFolder | None:
    """The masks in an XML or JSON file; None if it holds something else."""
    reader = {".xml": annotations, ".json": sav_file}.get(file.suffix.lower())
    return reader(file, labels) if reader else None
