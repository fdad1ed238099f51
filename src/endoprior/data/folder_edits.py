"""Write masks, poses or depth into a sequence folder that exists, and keep the originals. `T` frames."""

from __future__ import annotations

import os
import shutil
from collections.abc import Iterable, Mapping
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from ..core.checks import input_error
from ..system.atomic import remove_leftovers, temporary_sibling, whole_file, whole_folder, write_json
from .description import TOOLS_FOUND, read_description
from .images import read_tool_mask, save_png
from .sequence import FrameSequence

NOTE = "changes.json"  # In the folder of the original masks: the files that were changed, and by how many pixels
POSES, BACKUP = "poses_bounds.npy", "poses_bounds_before.npy"


def replace_masks(sequence: FrameSequence, masks: Mapping[int, NDArray[np.bool_]]) -> None:
    """Write masks, (H, W) True on tools, to their files; the first original of each goes to `masks_before` beside them.

    If the sequence has no mask files yet, their folder is made; `masks` must then hold every frame.
    """
    files, tool_value = writable_masks(sequence), sequence.mask_tool_value
    folder = files[0].parent
    kept = folder.with_name(f"{folder.name}_before")
    folder.mkdir(exist_ok=True)
    for frame, mask in masks.items():
        _keep_first(files[frame], kept / files[frame].name)
        write_mask(files[frame], mask, tool_value)
    if not kept.exists():
        return
    changed = {}
    for original in sorted(kept.glob("*.png")):
        before, now = (read_tool_mask(file, tool_value) for file in (original, folder / original.name))
        changed[original.name] = {"added_px": int((now & ~before).sum()), "removed_px": int((before & ~now).sum())}
    write_json(kept / NOTE, changed)


def _keep_first(file: Path, original: Path) -> bool:
    """Copy a file that will be replaced, unless there is none, or an older original; returns whether it was copied."""
    if not file.exists() or original.exists():
        return False
    with whole_file(original) as temporary:
        shutil.copyfile(file, temporary)
    return True


def writable_masks(sequence: FrameSequence) -> list[Path]:
    """The PNG of each frame's mask; they need not exist yet. InputError if none would be read, or it is read-only."""
    files = sequence.mask_files or sequence.new_mask_files
    if not files:
        fix = "Convert it to a sequence folder, or make a video of it for `endoprior prepare`."
        raise input_error(sequence.path, "a sequence folder with one mask file per frame", "another dataset", fix)
    for place in (files[0].parent, files[0].parent.parent):
        if place.exists():
            demand_writable(place)
    return files


def write_mask(file: Path, mask: NDArray[np.bool_], tool_value: int) -> None:
    """Write one mask, (H, W) True on tools, atomically; `tool_value` is that of tools in the file, 255 or 0."""
    with whole_file(file) as temporary:
        save_png(temporary, np.where(mask == (tool_value == 255), 255, 0).astype(np.uint8))


def note_found_masks(folder: Path, with_tools: float, followed_by: str = "") -> None:
    """Note in `sequence.json` of a sequence folder that a program found its masks; arguments as `found_source`."""
    path = folder / "sequence.json"
    described = read_description(path)
    sources = described.get("sources", {}) | {"masks": found_source(with_tools, followed_by)}
    write_json(path, described | {"sources": sources})


def found_source(with_tools: float, followed_by: str = "") -> str:
    """The source of masks that a program found in a share of the frames, 0..1, and another followed, if any."""
    found = f"{TOOLS_FOUND} in {with_tools:.0%} of the frames" if with_tools else f"no {TOOLS_FOUND}"
    return f"{found}, followed by {followed_by}" if followed_by else found


def pose_table(
    camera_to_world: NDArray[np.float64], height: int, width: int, focal: float, bounds: NDArray[np.float64]
) -> NDArray[np.float64]:
    """(T, 17) rows of `poses_bounds.npy`: 3x5 [R | t | (height, width, focal)], row-major, then near and far.

    `camera_to_world` is (T, 4, 4) in mm, with OpenCV axes; `bounds` (T, 2) the nearest and farthest depth, mm.
    """
    count = len(camera_to_world)
    size = np.broadcast_to([[height], [width], [focal]], (count, 3, 1))
    return np.concatenate([np.concatenate([camera_to_world[:, :3], size], 2).reshape(count, 15), bounds], 1)


def depth_bounds(stored: NDArray, scale: float) -> tuple[float, float]:
    """Nearest and farthest measured depth, mm, of stored values (0: missing); (0, 0) without any."""
    measured = stored[stored > 0]
    return (float(measured.min() * scale), float(measured.max() * scale)) if measured.size else (0.0, 0.0)


def demand_writable(folder: Path) -> None:
    """Raise InputError if the folder is read-only."""
    if not os.access(folder, os.W_OK):
        fix = "Copy the data folder to a place of your own, and use the copy."
        raise input_error(folder, "a folder that can be written", "a read-only one", fix)


def replace_poses(folder: Path, table: NDArray[np.float64], described: dict[str, Any], *, ours: bool) -> Path | None:
    """Write poses, as `pose_table` has them, and the description of a sequence folder, each atomically.

    Old poses are kept in `poses_bounds_before.npy`, which is returned, unless they are `ours`: of this program.
    """
    poses, kept = folder / POSES, folder / BACKUP
    was_kept = not ours and _keep_first(poses, kept)
    with whole_file(poses) as temporary, temporary.open("wb") as file:
        np.save(file, table)
    write_json(folder / "sequence.json", described)
    return kept if was_kept else None


def replace_depth(folder: Path, files: Iterable[tuple[str, NDArray[np.uint16]]]) -> None:
    """Replace the depth maps of a sequence folder, all or none, by name and (H, W) stored values of each."""
    old, new = folder / "depth", temporary_sibling(folder / "depth")
    aside = temporary_sibling(folder / "depth_old")
    shutil.rmtree(new, ignore_errors=True)
    with whole_folder(new) as temporary:
        for name, stored in files:
            save_png(temporary / name, stored, 2)
    old.rename(aside)
    new.rename(old)
    shutil.rmtree(aside, ignore_errors=True)
    remove_leftovers(folder)  # not before the depth maps are in place: theirs may be the only ones of a killed process
