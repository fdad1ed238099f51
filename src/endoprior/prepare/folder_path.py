"""The camera path of a sequence folder: estimate it and write it into the folder, as `prepare` does for a video."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from ..core.checks import input_error
from ..data.description import ESTIMATED_POSES, MOTION, PATH_RECORD, intrinsics_of, read_description
from ..data.edit import demand_writable, replace_depth, replace_poses
from ..data.files import CONFIDENCE, list_files
from ..data.frame_files import match_names
from ..data.images import decode_image, read_color, read_depth, read_tool_mask
from ..data.poses import POSES, depth_bounds, pose_table, read_poses_bounds
from ..data.scale import described_scale, without_scale
from ..footage.changes import find_changes
from ..system.atomic import write_json
from .camera_path.path import REFINED, CameraPath
from .camera_path.sequence_path import AS_OURS, ASSUMED, Reading, path_depth, sequence_path
from .camera_path.tracks import PoseInput, TrackingCamera

STATIC = "static camera"
DEPTH_OF_OLD_PATH = "depth was measured by parallax with the path before; `endoprior prepare` measures it anew"
SCALE_AGAIN = "To have mm, give it again: `endoprior scale DATA --known-length FRAME,X1,Y1,X2,Y2,MM`"


@dataclass(frozen=True)
class FolderPath:
    """What was found and written."""

    camera_to_world: NDArray[np.float64]  # (T, 4, 4) mm
    relative: bool  # lengths have no unit
    unexplained: list[int]  # frames without a pose, or of another scene
    kept: Path | None  # the file of the poses that were there, if it was kept
    notes: list[str]  # notes for the user, one line each


def write_folder_path(
    folder: Path,
    how: str = "auto",
    progress: Callable[[int, int], None] = lambda _done, _total: None,
    *,
    reading: Reading = AS_OURS,
) -> FolderPath:
    """Find the camera path of a sequence folder and write it there, with relative depth at the scale of the path.

    Args:
        folder: with `images/ masks/ depth/` and, for the focal length, `sequence.json` or old poses.
        how: as `--poses` of `prepare`.
        reading: how the matrices of a file are to be read.
        progress: is told the number of frames followed, and of all.
    Raises:
        InputError: no sequence folder, read-only, or the poses named by `how` cannot be used; nothing is written.
    """
    demand_writable(folder)
    images = list_files(folder / "images", (".png",), "EndoNeRF")
    names = [file.stem for file in images]
    masks, depths = (of_all_images(folder / part, names) for part in ("masks", "depth"))
    described = read_description(folder / "sequence.json")
    height, width = read_color(images[0]).shape[:2]
    size, scale = (width, height), float(described.get("depth_scale", 1.0))
    focal = _focal(folder, described, images)
    fx, fy, cx, cy = intrinsics_of(folder / "sequence.json", described, width, height, focal)
    matrix = np.array([[fx, 0, cx], [0, fy, cy], [0, 0, 1]])
    tool_value, relative = described.get("mask_tool_value", 255), described.get("depth_relative", False)
    known = described_scale(folder / "sequence.json", described)
    guessed = relative or known is not None  # each frame's depth has a scale of its own, whether its unit is mm or not
    sources, count = described.get("sources", {}), len(images)

    def color(index: int) -> NDArray[np.uint8]:
        return read_color(images[index], size)

    def tissue(index: int) -> NDArray[np.bool_]:
        return ~read_tool_mask(masks[index], tool_value, size)

    path, notes = sequence_path(
        how,
        lambda i: PoseInput(color(i), tissue(i), read_depth(depths[i], scale, size)),
        lambda: (map(color, range(count)), map(tissue, range(count))),
        count,
        TrackingCamera.centered_at_half(matrix, width, guessed, described.get("baseline_mm")),
        size,
        has_depth=True,
        refine_focal=sources.get("lens") in (ASSUMED, REFINED),
        reading=replace(reading, image_times=_times(described, count), image_names=names),
        progress=lambda done: progress(done, count),
    )
    lost = path.lost if path else list[int]()
    unexplained = sorted({*lost, *find_changes(map(color, range(count))).off_color})
    new = path or CameraPath(np.tile(np.eye(4), (count, 1, 1)), np.ones(count, bool), np.ones(count))
    if known is not None and path is not None:
        notes.append(f"frames get other depth: the scale ({known.source}) is lost. {SCALE_AGAIN}")
        relative, described = True, without_scale(described)
        write_json(folder / "sequence.json", described)  # before the depth that it is wrong for
    if relative and path is not None:
        shaped = enumerate(depths)
        replace_depth(folder, ((f.name, path_depth(path, i, decode_image(f, size), scale)) for i, f in shaped))
    if (folder / CONFIDENCE).is_dir():
        notes.append(DEPTH_OF_OLD_PATH)
    focal = fx * new.focal_factor
    bounds = np.array([depth_bounds(decode_image(file, size), scale) for file in depths])
    facts = {"width": width, "height": height, "fx": focal, "fy": fy * new.focal_factor, "cx": cx, "cy": cy}
    still = {name: text for name, text in sources.items() if name != MOTION} | {"poses": STATIC}
    origin = still if path is None else path.sources(sources)
    more = facts | {"sources": origin, "unexplained_frames": unexplained}
    table = pose_table(new.camera_to_world, height, width, focal, bounds)
    kept = replace_poses(folder, table, described | more, ours=sources.get("poses") in ESTIMATED_POSES)
    if path is not None:
        write_json(folder / PATH_RECORD, path.record())
    return FolderPath(new.camera_to_world, relative, unexplained, kept, notes)


def of_all_images(folder: Path, names: list[str]) -> list[Path]:
    """The file in a folder of each image, of these names without suffixes."""
    files = list_files(folder, (".png",), "EndoNeRF")
    matched = match_names(folder, [file.name for file in files], range(len(names)), names)
    return [files[position] for position in matched.files.values()]


def _times(described: dict[str, Any], count: int) -> list[float]:
    """Of each frame, s; empty where `sequence.json` has no frame rate."""
    rate = described.get("frames_per_second")
    return [i / rate for i in range(count)] if rate else []


def _focal(folder: Path, described: dict[str, Any], images: list[Path]) -> float:
    """The focal length of the old poses, px, where `sequence.json` has none."""
    if "fx" in described:
        return float(described["fx"])
    if not (folder / POSES).exists():
        fix = 'write it to sequence.json: {"fx": 600.0}, px.'
        raise input_error(folder / "sequence.json", "the focal length fx", "neither that nor old poses", fix)
    focal = float(read_poses_bounds(folder / POSES, len(images))[0, 2, 4])
    if not focal > 0:
        raise input_error(folder / POSES, "a focal length > 0 px", f"{focal:g}", "correct row 0, column 14.")
    return focal
