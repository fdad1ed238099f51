"""Changes parts of a sequence folder: masks, poses, depth, and its scale.

What replaces masks or poses keeps the originals. A scale brings relative depth to mm, in all files or none: depth files
are not rewritten. `depth_scale` of `sequence.json`, mm per stored unit, has the factor in it, and `scale_factor` says
which, so that another scale replaces it. Poses and known points are stored in mm, and change.
"""

from __future__ import annotations

import os
import shutil
from collections.abc import Iterable, Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from ..core.checks import input_error
from ..core.shell import command
from ..system.atomic import remove_leftovers, temporary_sibling, whole_file, whole_folder, write_json
from .description import PATH_RECORD, SCALE_PENDING, read_description
from .found_tools import found_source
from .images import read_tool_mask, save_png, write_tool_mask
from .poses import POSES, scaled_poses
from .reading import read_json, read_numpy, read_parts
from .scale import Scale, demand_relative, described_scale
from .sequence import FrameSequence

NOTE = "changes.json"  # In the folder of the original masks: the files that were changed, and by how many pixels
BACKUP = "poses_bounds_before.npy"
LENGTHS_OF_PATH = {"translation_std_mm"}  # lists of lengths in `camera_path.json`
TRACKS = Path("truth", "tracks.npz")  # known points, which `prepare --stir` lifts by the depth


def replace_masks(sequence: FrameSequence, tool_masks: Mapping[int, NDArray[np.bool_]]) -> None:
    """Write masks, (H, W) True on tools, to their files; the first original of each goes to `masks_before` beside them.

    If the sequence has no mask files yet, their folder is made; `tool_masks` must then hold every frame.
    """
    files, tool_value = writable_masks(sequence), sequence.mask_tool_value
    folder = files[0].parent
    kept = folder.with_name(f"{folder.name}_before")
    folder.mkdir(exist_ok=True)
    for frame, tool_mask in tool_masks.items():
        _keep_first(files[frame], kept / files[frame].name)
        write_tool_mask(files[frame], tool_mask, tool_value)
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


def note_found_masks(folder: Path, with_tools: float, followed_by: str = "") -> None:
    """Note in `sequence.json` of a sequence folder that a program found its masks; arguments as `found_source`."""
    path = folder / "sequence.json"
    described = read_description(path)
    sources = described.get("sources", {}) | {"masks": found_source(with_tools, followed_by)}
    write_json(path, described | {"sources": sources})


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


def write_scale(folder: Path, scale: Scale) -> None:
    """Bring a sequence folder of relative depth to mm, or replace the scale that it has.

    All files that change are written to a folder of their own first, and then moved to their places. If that is
    interrupted, readers say so, and the next call finishes it first.

    Raises:
        InputError: no such folder, read-only, or its depth is in mm by measurement.
    """
    demand_writable(folder)
    finish_scale(folder)
    path = folder / "sequence.json"
    described = read_description(path)
    old = described_scale(path, described)
    demand_relative(folder, described)
    ratio = scale.factor / (old.factor if old else 1.0)
    unit = float(described.get("depth_scale", 1.0)) * ratio
    new = described | {"depth_scale": unit, "depth_relative": False} | scale.described
    with whole_folder(folder / SCALE_PENDING) as pending:
        if (folder / POSES).exists():
            with whole_file(pending / POSES) as temporary, temporary.open("wb") as file:
                np.save(file, scaled_poses(_read_table(folder / POSES), ratio))
        if (folder / PATH_RECORD).exists():
            write_json(pending / PATH_RECORD, scaled_record(_read_path(folder / PATH_RECORD), ratio))
        if (folder / TRACKS).exists():
            _scale_tracks(folder / TRACKS, pending / TRACKS.name, ratio)
        write_json(pending / "sequence.json", new)
    finish_scale(folder)


def finish_scale(folder: Path) -> bool:
    """Move the files of an interrupted `write_scale` to their places; False if there was none."""
    pending = folder / SCALE_PENDING
    if not pending.is_dir():
        return False
    # What describes the others comes last.
    for file in sorted(pending.iterdir(), key=lambda each: each.name == "sequence.json"):
        os.replace(file, folder / (TRACKS if file.name == TRACKS.name else file.name))
    shutil.rmtree(pending)
    return True


def scaled_record(record: dict[str, Any], ratio: float) -> dict[str, Any]:
    """The content of `camera_path.json` with its lengths multiplied."""

    def times(values: Sequence[float | None]) -> list[float | None]:
        return [None if value is None else round(value * ratio, 5) for value in values]

    return record | {name: times(record[name]) for name in LENGTHS_OF_PATH if name in record}


def _read_table(file: Path) -> NDArray[np.float64]:
    fix = f"find them again: `{command('poses', file.parent)}`."
    table = read_numpy(file, "a NumPy file", fix)
    if not isinstance(table, np.ndarray) or table.ndim != 2 or table.shape[1] != 17 or table.dtype.kind not in "iuf":
        raise input_error(file, "rows of 17 numbers", "something else", fix)
    return table


def _read_path(file: Path) -> dict[str, Any]:
    stored, fix = read_json(file), f"remove it, or find the path again: `{command('poses', file.parent)}`."
    lengths = {name: tuple[float | int | None, ...] for name in LENGTHS_OF_PATH & stored.keys()}
    return read_parts(file, lengths, fix)


def _scale_tracks(file: Path, target: Path, ratio: float) -> None:
    fix = "remove it, or write it again."
    arrays = read_numpy(file, "a NumPy file", fix)
    points = arrays.get("points") if isinstance(arrays, dict) else None
    if not isinstance(arrays, dict) or points is None or points.dtype.kind != "f":
        raise input_error(file, "an array points", "none of real numbers", fix)
    arrays["points"] = (points * ratio).astype(points.dtype)
    with whole_file(target) as temporary:
        np.savez_compressed(temporary, **arrays)  # pyright: ignore[reportArgumentType]  # allow_pickle: NumPy >= 2.1
