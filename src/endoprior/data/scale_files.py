"""Bring a sequence folder of relative depth to mm: all of its files, or none.

Depth files are not rewritten. `depth_scale` of `sequence.json`, mm per stored unit, has the factor in it, and
`scale_factor` says which, so that another scale replaces it. Poses and known points are stored in mm, and change.
"""

from __future__ import annotations

import os
import shutil
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from ..core.checks import input_error
from ..core.shell import command
from ..system.atomic import whole_file, whole_folder, write_json
from .description import PATH_RECORD, SCALE_PENDING, read_description
from .poses import POSES, scaled_poses
from .reading import read_json, read_numpy, read_parts
from .scale import Scale, demand_relative, described_scale
from .writer import demand_writable

LENGTHS_OF_PATH = {"translation_std_mm"}  # lists of lengths in `camera_path.json`
TRACKS = Path("truth", "tracks.npz")  # known points, which `prepare --stir` lifts by the depth


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
