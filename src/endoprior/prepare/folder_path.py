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
from ..data.scale import Scale, described_scale, without_scale
from ..footage.changes import find_changes
from ..system.atomic import write_json
from .camera_path.path import REFINED, CameraPath
from .camera_path.sequence_path import AS_OURS, ASSUMED, Reading, path_depth, sequence_path
from .camera_path.tracks import FrameReader, TrackingCamera

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
    data = _Folder.open(folder)
    path, notes = sequence_path(
        how,
        data.reader,
        data.camera,
        reading=replace(reading, image_times=data.times, image_names=data.names),
        progress=lambda done: progress(done, len(data.images)),
    )
    colors = map(data.color, range(len(data.images)))
    lost = path.lost if path else list[int]()
    unexplained = sorted({*lost, *find_changes(colors).off_color})
    if path is not None:
        notes += _use_path(data, path)
    if (folder / CONFIDENCE).is_dir():
        notes.append(DEPTH_OF_OLD_PATH)
    poses, kept = _write_poses(data, path, unexplained)
    return FolderPath(poses, data.is_relative, unexplained, kept, notes)


@dataclass
class _Folder:
    """The files of a sequence folder, and its description."""

    path: Path
    images: list[Path]
    masks: list[Path]
    depths: list[Path]
    described: dict[str, Any]  # what `sequence.json` holds
    size: tuple[int, int]  # (width, height), px
    intrinsics: tuple[float, float, float, float]  # fx, fy, cx, cy, px; the left-most pixel is centered at 0.5
    scale: Scale | None  # by which relative depth became mm

    @classmethod
    def open(cls, path: Path) -> _Folder:
        """Find the files; InputError if it is no sequence folder."""
        images = list_files(path / "images", (".png",), "EndoNeRF")
        names = [file.stem for file in images]
        masks, depths = (of_all_images(path / part, names) for part in ("masks", "depth"))
        description = path / "sequence.json"
        described = read_description(description)
        height, width = read_color(images[0]).shape[:2]
        intrinsics = intrinsics_of(description, described, width, height, _focal(path, described, images))
        scale = described_scale(description, described)
        return cls(path, images, masks, depths, described, (width, height), intrinsics, scale)

    @property
    def names(self) -> list[str]:
        return [file.stem for file in self.images]

    @property
    def times(self) -> list[float]:
        """Of each frame, s; empty where `sequence.json` has no frame rate."""
        rate = self.described.get("frames_per_second")
        return [i / rate for i in range(len(self.images))] if rate else []

    @property
    def sources(self) -> dict[str, str]:
        return self.described.get("sources", {})

    @property
    def is_relative(self) -> bool:
        """Whether lengths have no unit."""
        return self.described.get("depth_relative", False)

    @property
    def depth_scale(self) -> float:
        """mm per unit of the depth files."""
        return float(self.described.get("depth_scale", 1.0))

    @property
    def camera(self) -> TrackingCamera:
        fx, fy, cx, cy = self.intrinsics
        return TrackingCamera.centered_at_half(
            np.array([[fx, 0, cx], [0, fy, cy], [0, 0, 1]]),
            self.size,
            self.is_relative or self.scale is not None,  # each frame's depth has a scale of its own, in mm or not
            self.described.get("baseline_mm"),
            focal_is_assumed=self.sources.get("lens") in (ASSUMED, REFINED),
        )

    @property
    def reader(self) -> FrameReader:
        return FrameReader(self.color, self.tissue, self.depth, len(self.images))

    def color(self, index: int) -> NDArray[np.uint8]:
        return read_color(self.images[index], self.size)

    def tissue(self, index: int) -> NDArray[np.bool_]:
        return ~read_tool_mask(self.masks[index], self.described.get("mask_tool_value", 255), self.size)

    def depth(self, index: int) -> NDArray[np.float32]:
        return read_depth(self.depths[index], self.depth_scale, self.size)

    def stored_depth(self, index: int) -> NDArray:
        """(H, W) the numbers of a depth file."""
        return decode_image(self.depths[index], self.size)


def _use_path(data: _Folder, path: CameraPath) -> list[str]:
    """Bring relative depth to the scale of the path; notes for the user."""
    notes = []
    if data.scale is not None:
        notes.append(f"frames get other depth: the scale ({data.scale.source}) is lost. {SCALE_AGAIN}")
        data.described, data.scale = without_scale(data.described), None
        write_json(data.path / "sequence.json", data.described)  # before the depth that it is wrong for
    if data.is_relative:
        shaped = (
            (file.name, path_depth(path, i, data.stored_depth(i), data.depth_scale))
            for i, file in enumerate(data.depths)
        )
        replace_depth(data.path, shaped)
    return notes


def _write_poses(
    data: _Folder, path: CameraPath | None, unexplained: list[int]
) -> tuple[NDArray[np.float64], Path | None]:
    """Write the path, or that of a static camera, and describe it; (T, 4, 4) poses, and where old ones are kept."""
    count, (width, height), (fx, fy, cx, cy) = len(data.images), data.size, data.intrinsics
    new = path or CameraPath(np.tile(np.eye(4), (count, 1, 1)), np.ones(count, bool), np.ones(count))
    focal = fx * new.focal_factor
    bounds = np.array([depth_bounds(data.stored_depth(i), data.depth_scale) for i in range(count)])
    still = {name: text for name, text in data.sources.items() if name != MOTION} | {"poses": STATIC}
    facts = {
        **{"width": width, "height": height, "fx": focal, "fy": fy * new.focal_factor, "cx": cx, "cy": cy},
        "sources": still if path is None else path.sources(data.sources),
        "unexplained_frames": unexplained,
    }
    table = pose_table(new.camera_to_world, height, width, focal, bounds)
    ours = data.sources.get("poses") in ESTIMATED_POSES
    kept = replace_poses(data.path, table, data.described | facts, ours=ours)
    if path is not None:
        write_json(data.path / PATH_RECORD, path.record())
    return new.camera_to_world, kept


def of_all_images(folder: Path, names: list[str]) -> list[Path]:
    """The file in a folder of each image, of these names without suffixes."""
    files = list_files(folder, (".png",), "EndoNeRF")
    matched = match_names(folder, [file.name for file in files], range(len(names)), names)
    return [files[position] for position in matched.files.values()]


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
