"""Write camera poses: the table `poses_bounds.npy`, and new poses into a sequence folder. `T` frames."""

from __future__ import annotations

import os
import shutil
from collections.abc import Iterable
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from ..core.checks import input_error
from ..system.atomic import remove_leftovers, temporary_sibling, whole_file, whole_folder, write_json
from .images import save_png

POSES, BACKUP = "poses_bounds.npy", "poses_bounds_before.npy"


def pose_table(
    camera_to_world: NDArray[np.float64], height: int, width: int, focal: float, bounds: NDArray[np.float64]
) -> NDArray[np.float64]:
    """(T, 17) rows of `poses_bounds.npy`: 3x5 [R | t | (height, width, focal)], row-major, then near and far.

    Args:
        camera_to_world: (T, 4, 4) mm, OpenCV axes.
        focal: px.
        bounds: (T, 2) nearest and farthest depth, mm.
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
    """Write poses and the description of a sequence folder, each atomically.

    Args:
        table: (T, 17), as `pose_table` has it.
        described: contents of `sequence.json`.
        ours: the poses there were estimated by this program; others are kept in `poses_bounds_before.npy`.
    Returns:
        The file of the old poses, if it was kept.
    """
    poses, kept = folder / POSES, folder / BACKUP
    keep = poses.exists() and not ours and not kept.exists()
    if keep:
        with whole_file(kept) as temporary:
            shutil.copyfile(poses, temporary)
    with whole_file(poses) as temporary, temporary.open("wb") as file:
        np.save(file, table)
    write_json(folder / "sequence.json", described)
    return kept if keep else None


def replace_depth(folder: Path, files: Iterable[tuple[str, NDArray[np.uint16]]]) -> None:
    """Replace the depth maps of a sequence folder, all or none.

    Args:
        files: name and (H, W) stored values of each.
    """
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
