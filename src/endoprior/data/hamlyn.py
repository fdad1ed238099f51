"""Reader of Hamlyn sequences in two layouts: Forplane's (`images/ gt_masks/ gt_depth/`) and `rectifiedNN`.

Neither has camera poses: the camera is assumed to be static.
"""

from __future__ import annotations

from pathlib import Path

import numpy as np

from ..core.checks import input_error
from ..core.config import DataConfig
from ..core.types import Camera
from .assemble import Pixels, assemble, kept_frames
from .depth_files import read_depth_file
from .endonerf import focal_at, read_poses_bounds
from .files import IMAGE_SUFFIXES, demand_count, list_files, read_table, unequal_names
from .formats import Format
from .images import read_color, read_tool_mask
from .poses import identity_poses
from .sequence import FrameSequence

CROP_LEFT_PX = 40
"""Empty columns at the left of Forplane's images; its own program crops them, too."""


def is_hamlyn(path: Path) -> bool:
    """Whether a folder is a Hamlyn sequence; Forplane's have `gt_depth/`, or `hamlyn` in their name."""
    named = any("hamlyn" in name.lower() for name in (path.name, path.parent.name))
    # A folder that this program prepared from a Hamlyn video has a sequence.json and no empty columns.
    bare = (path / "poses_bounds.npy").exists() and not (path / "sequence.json").exists()
    forplane = (path / "images").is_dir() and ((path / "gt_depth").is_dir() or (named and bare))
    return forplane or _is_rectified(path)


def load_hamlyn(path: Path, cfg: DataConfig) -> FrameSequence:
    """Open a Hamlyn sequence.

    Raises:
        InputError: files are missing, their numbers differ, or they cannot be used.
    """
    return _load_rectified(path, cfg) if _is_rectified(path) else _load_forplane(path, cfg)


def _is_rectified(path: Path) -> bool:
    return (path / "image01").is_dir() and (path / "depth01").is_dir()


def _load_forplane(path: Path, cfg: DataConfig) -> FrameSequence:
    """`images/`, `gt_masks/` or `masks/`, `gt_depth/` or `depth/`; size and focal length from `poses_bounds.npy`."""
    mask_folder = "gt_masks" if (path / "gt_masks").is_dir() else "masks"
    depth_folder = "gt_depth" if (path / "gt_depth").is_dir() else "depth"
    folders = ("images", mask_folder, depth_folder)
    images, masks, depths = (list_files(path / name, (".png",), "Forplane") for name in folders)
    demand_count(masks, path / mask_folder, len(images))
    demand_count(depths, path / depth_folder, len(images))
    height, width = read_color(images[0]).shape[:2]
    if width <= CROP_LEFT_PX:
        raise input_error(images[0], f"more than {CROP_LEFT_PX} columns", f"{width}", "pass images of full size.")
    # All rows must be finite, but only size and focal length are used: Forplane's camera is static.
    stored = read_poses_bounds(path / "poses_bounds.npy", len(images))[0, :, 4]
    remarks: list[str] = []
    # Some files hold the size after the crop, which leaves the focal length as it is.
    across = width - CROP_LEFT_PX if stored[1] == width - CROP_LEFT_PX else width
    focal = focal_at(path / "poses_bounds.npy", stored, across, height, remarks)
    remarks += unequal_names(images, masks) + unequal_names(images, depths)
    remarks.append(f"{path}: {CROP_LEFT_PX} empty columns at the left are cropped, as in Forplane")
    if not cfg.depth_unit_mm:
        remarks.append(f"{path / depth_folder}: its unit is not documented, mm assumed; set data.depth_unit_mm")
    kept = kept_frames(len(images), cfg)
    images, masks, depths = ([files[i] for i in kept] for files in (images, masks, depths))
    size = (width, height)

    def decode(index: int) -> Pixels:
        depth = read_depth_file(depths[index], cfg.depth_unit_mm or 1.0, size)
        pixels = read_color(images[index], size), ~read_tool_mask(masks[index], 255, size), depth
        return tuple(np.ascontiguousarray(image[:, CROP_LEFT_PX:]) for image in pixels)

    # The principal point moves by the whole crop; Forplane moves it by half of that, which is a different camera.
    shape = (width - CROP_LEFT_PX, height, focal, focal, width / 2 - CROP_LEFT_PX, height / 2)
    return assemble(
        path,
        cfg,
        [Camera(*shape, pose) for pose in identity_poses(len(kept))],
        decode,
        images=images,
        files=[*masks, *depths, path / "poses_bounds.npy"],
        remarks=remarks,
        mask_folder=mask_folder,
        depth_is_relative=not cfg.depth_unit_mm,
        sources={"depth": "stereo matching, by Forplane"},
    )


def _load_rectified(path: Path, cfg: DataConfig) -> FrameSequence:
    """`image01/`, `depth01/` in mm, `intrinsics.txt`; no masks."""
    images = list_files(path / "image01", IMAGE_SUFFIXES, "Hamlyn")
    depths = list_files(path / "depth01", (".png",), "Hamlyn")
    demand_count(depths, path / "depth01", len(images))
    number = path.name[-2:]
    places = [path / "intrinsics.txt", path.parent / "calibration" / number / "intrinsics.txt"]
    calibration = next((place for place in places if place.exists()), places[0])
    hint = "put the dataset's intrinsics.txt, a 3x3 camera matrix, beside image01/."
    matrix = read_table(calibration, hint)
    if matrix.shape not in ((3, 3), (3, 4)) or min(matrix[0, 0], matrix[1, 1]) <= 0 or not np.isfinite(matrix).all():
        raise input_error(calibration, "a 3x3 camera matrix", f"shape {matrix.shape} or other numbers", hint)
    height, width = read_color(images[0]).shape[:2]
    remarks = [*unequal_names(images, depths), f"{path}: no tool masks, every pixel counts as tissue"]
    remarks.append(f"{path}: no camera poses, the camera is assumed to be static")
    kept = kept_frames(len(images), cfg)
    images, depths = ([files[i] for i in kept] for files in (images, depths))
    size = (width, height)

    def decode(index: int) -> Pixels:
        depth = read_depth_file(depths[index], cfg.depth_unit_mm or 1.0, size)
        return read_color(images[index], size), np.ones((height, width), bool), depth

    shape = (width, height, matrix[0, 0], matrix[1, 1], matrix[0, 2] + 0.5, matrix[1, 2] + 0.5)
    return assemble(
        path,
        cfg,
        [Camera(*shape, pose) for pose in identity_poses(len(kept))],
        decode,
        images=images,
        # A calibration outside the folder has no name below it, which the fingerprint needs.
        files=[*depths, *([calibration] if calibration.parent == path else [])],
        remarks=remarks,
        mask_folder="image01",
        sources={"depth": "stereo matching"},
    )


FORMAT = Format(is_hamlyn, load_hamlyn)
