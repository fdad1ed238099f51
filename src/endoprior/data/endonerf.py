"""Reader of the EndoNeRF layout: `images/ masks/ depth/`, `poses_bounds.npy`, `sequence.json`.

`N` frames. Cheap facts (counts, poses, the description) are checked on loading, files when they are decoded.
"""

from __future__ import annotations

from pathlib import Path
from typing import Any, Literal

import numpy as np
from numpy.typing import NDArray

from ..core.checks import input_error
from ..core.config import DataConfig
from ..core.types import Camera
from .assemble import Pixels, assemble, kept_frames
from .description import check_frames, intrinsics_of, read_description
from .files import list_files
from .formats import Format
from .frame_files import files_of_images
from .images import read_color, read_depth, read_tool_mask
from .numpy_files import read_numpy
from .poses import demand_rotations, world_to_camera
from .right_eye import open_right_eye
from .sequence import FrameSequence
from .truth import Truth

POSES_HINT = "write one row of 17 numbers per frame: 3x5 [R | t | (H, W, focal)], near, far."
ROUNDED_PX = 1.0
"""Scaled images may differ from the exact shape by rounding."""
STILL_HINT = f"{POSES_HINT[:-1]}; for a static camera, set data.format to plain."


def is_endonerf(path: Path) -> bool:
    """Whether a folder has stored poses, or PNG files in the three folders that belong to them."""
    has_poses = (path / "poses_bounds.npy").exists()
    return has_poses or all(any((path / name).glob("*.png")) for name in ("images", "masks", "depth"))


def load_endonerf(
    path: Path,
    cfg: DataConfig,
    *,
    pose_axes: Literal["opencv", "opengl"] = "opencv",
    facts: dict[str, Any] | None = None,
    fact_files: list[Path] | None = None,
) -> FrameSequence:
    """Open a folder in the EndoNeRF layout.

    Args:
        path: the folder.
        cfg: which frames and masks are read and how depth is cleaned.
        pose_axes: meaning of the columns of the stored camera-to-world matrices: `opencv` (x right, y down,
            z forward; as stored by EndoNeRF) or `opengl` (x right, y up, z backward).
        facts: entries of `sequence.json` that a dataset has elsewhere; the file itself overrides them.
        fact_files: the files they come from.
    Raises:
        InputError: the folder is not a sequence.
    """
    folders = ("images", "gt_masks" if cfg.use_gt_masks else "masks", "depth")
    images, masks, depths = (list_files(path / name, (".png",), "EndoNeRF") for name in folders)
    if len(images) < 2:
        raise input_error(path / "images", "at least 2 frames, 1 to train and 1 to test", "1", "add frames.")
    own_description = read_description(path / "sequence.json")
    described = (facts or {}) | own_description
    height, width = read_color(images[0]).shape[:2]
    remarks: list[str] = []
    masks = files_of_images(path / folders[1], masks, "masks", images, remarks)
    depths = files_of_images(path / folders[2], depths, "depth", images, remarks)
    poses = read_poses_bounds(path / "poses_bounds.npy", len(images))
    cameras = _cameras(poses, described, width, height, pose_axes, path, remarks)
    remarks += check_frames(path / "sequence.json", described, len(images))
    kept = [i for i in kept_frames(len(images), cfg) if i in masks and i in depths]
    size, scale = (width, height), cfg.depth_unit_mm or described.get("depth_scale", 1.0)
    relative = described.get("depth_relative", False)
    right_eye = open_right_eye(path, images, kept, size, described, cfg.shrink, remarks, relative=relative)
    images, masks, depths = ([files[i] for i in kept] for files in (images, masks, depths))
    tool_value = described.get("mask_tool_value", 255)

    def decode(index: int) -> Pixels:
        tool = read_tool_mask(masks[index], tool_value, size)
        return read_color(images[index], size), ~tool, read_depth(depths[index], scale, size)

    truth = None
    if (path / "truth").is_dir():
        truth = Truth(path / "truth", [file.stem for file in images])
        if cfg.shrink > 1 or len(kept) < len(cameras):
            truth = None
            remarks.append(f"{path / 'truth'}: ignored, because it belongs to the whole sequence at full size")
    rate = described.get("frames_per_second")
    description = [path / "sequence.json"] if own_description else []
    return assemble(
        path,
        cfg,
        [cameras[i] for i in kept],
        decode,
        images=images,
        files=[*masks, *depths, path / "poses_bounds.npy", *description, *(fact_files or [])],
        frames_per_second=float(rate) / (cfg.stride or 1) if rate is not None else None,
        truth=truth,
        right_eye=right_eye,
        remarks=remarks,
        mask_folder=folders[1],
        mask_files=masks,
        mask_tool_value=tool_value,
        depth_is_relative=relative,
        sources=described.get("sources"),
    )


def read_poses_bounds(path: Path, num_frames: int) -> NDArray[np.float64]:
    """(N, 3, 5) camera-to-world [R | t | (height, width, focal)] from `poses_bounds.npy`, checked.

    Raises:
        InputError: missing, of another shape, not finite, or not rotations.
    """
    if not path.exists():
        raise input_error(path, "camera poses", "no such file", STILL_HINT)
    stored = read_numpy(path, "a NumPy file", POSES_HINT)
    if not isinstance(stored, np.ndarray) or stored.shape != (num_frames, 17):
        raise input_error(path, f"shape ({num_frames}, 17)", str(getattr(stored, "shape", "an archive")), POSES_HINT)
    if not np.issubdtype(stored.dtype, np.number) or not np.isfinite(stored[:, :15].astype(np.float64)).all():
        raise input_error(path, "finite numbers", "NaN, infinity or other values", POSES_HINT)
    poses = stored[:, :15].astype(np.float64).reshape(-1, 3, 5)
    demand_rotations(path, poses[:, :, :3], "columns 0-2", POSES_HINT)
    return poses


def focal_at(path: Path, stored: NDArray[np.float64], width: int, height: int, remarks: list[str]) -> float:
    """Focal length, px, of images of that size, from the (height, width, focal) of `poses_bounds.npy`.

    Files often hold the size of the original video beside smaller images; then the focal length is scaled, and a remark
    says so.

    Raises:
        InputError: not above 0, or the stored size has another shape, so that the images were cut.
    """
    old_height, old_width, focal = stored
    if focal <= 0:
        raise input_error(path, "a focal length > 0 px", f"{focal:g}", "correct row 0, column 14.")
    if (old_width, old_height) == (width, height):
        return float(focal)
    got, scale = f"{old_width:g}x{old_height:g}", width / old_width if old_width > 0 else 0.0
    if abs(scale * old_height - height) > ROUNDED_PX or not scale:
        fix = "write the size and focal length of these images there, or fx, fy, cx, cy into sequence.json."
        raise input_error(path, f"the size of the images, {width}x{height} px, or that shape", got, fix)
    remarks.append(
        f"{path}: its focal length, {focal:g} px, is for {got} px; scaled to {focal * scale:g} px for {width}x{height}"
    )
    return float(focal * scale)


def _cameras(
    poses: NDArray[np.float64],
    described: dict[str, Any],
    width: int,
    height: int,
    pose_axes: Literal["opencv", "opengl"],
    path: Path,
    remarks: list[str],
) -> list[Camera]:
    """One camera per frame. Intrinsics come from `sequence.json` where it has them, else from row 0 of the poses."""
    focal = 0.0
    if "fx" not in described:
        focal = focal_at(path / "poses_bounds.npy", poses[0, :, 4], width, height, remarks)
    intrinsics = intrinsics_of(path / "sequence.json", described, width, height, focal)
    flip = np.array([1.0, 1.0, 1.0] if pose_axes == "opencv" else [1.0, -1.0, -1.0])
    return [Camera(width, height, *intrinsics, world_to_camera(pose[:, :3] * flip, pose[:, 3])) for pose in poses]


FORMAT = Format(is_endonerf, load_endonerf)
