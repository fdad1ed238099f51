"""Reader of the EndoNeRF layout: `images/ masks/ depth/` matched by sorted order, `poses_bounds.npy`, `sequence.json`.

`N` frames. Cheap facts (counts, poses, the description) are checked on loading, files when they are decoded.
"""

from __future__ import annotations

import json
import math
import re
from pathlib import Path
from typing import Any, Literal
from zipfile import BadZipFile

import numpy as np
from numpy.typing import NDArray

from ..config import DataConfig
from ..types import Camera, Frame
from .depth import clean_depth
from .images import complaint, read_color, read_depth, read_tool_mask
from .sequence import Sequence
from .shrink import shrunk, shrunk_camera
from .truth import Truth

ROTATION_TOLERANCE = 1e-3
"""Largest entry of R^T R - I that still passes for a rotation: far above float32 rounding, far below a real scale."""


def load_sequence(
    path: str | Path, cfg: DataConfig | None = None, *, pose_axes: Literal["opencv", "opengl"] = "opencv"
) -> Sequence:
    """Open a sequence folder; frames are decoded when they are used.

    Args:
        path: the folder.
        cfg: which masks are read and how depth is cleaned.
        pose_axes: meaning of the columns of the stored camera-to-world matrices: `opencv` (x right, y down,
            z forward; as stored by EndoNeRF) or `opengl` (x right, y up, z backward).
    Raises:
        InputError: the folder is not a sequence; one line with file, expectation, finding and next step.
        ValueError: unknown `pose_axes`.
    """
    if pose_axes not in ("opencv", "opengl"):
        raise ValueError(f"pose_axes must be opencv or opengl; got {pose_axes!r}")
    cfg = cfg or DataConfig()
    path = Path(path).expanduser()
    if not path.is_dir():
        got = "a file" if path.exists() else "no such folder"
        raise complaint(path, "a sequence folder", got, "Pass the folder that holds images/, masks/ and depth/.")
    folders = ("images", "gt_masks" if cfg.use_gt_masks else "masks", "depth")
    images, masks, depths = (_list_png(path / name) for name in folders)
    for name, files in zip(folders[1:], (masks, depths), strict=True):
        if len(files) != len(images):
            raise complaint(
                path / name, f"{len(images)} files, one per image", f"{len(files)}", "Add or remove files to match."
            )
    if len(images) < 2:
        raise complaint(path / "images", "at least 2 frames, 1 to train and 1 to test", "1", "Add frames.")
    described = _read_description(path / "sequence.json")
    first = read_color(images[0])
    height, width = first.shape[:2]
    remarks: list[str] = _unequal_names(images, masks) + _unequal_names(images, depths)
    poses = _read_poses(path / "poses_bounds.npy", len(images))
    cameras = _cameras(poses, described, width, height, pose_axes, path, remarks)
    count = min(cfg.first_frames or len(images), len(images))
    if count < 2 or min(width, height) // cfg.shrink < 1:
        hint = "Lower data.shrink or raise data.first_frames."
        raise complaint(path, "2 frames of 1x1 px to be left", f"{count} of {width}x{height} / {cfg.shrink}", hint)

    def read_frame(index: int) -> Frame:
        size = (width, height)
        depth, depth_valid = clean_depth(read_depth(depths[index], described.get("depth_scale", 1.0), size), cfg)
        frame = Frame(
            index=index,
            time=index / count,
            camera=cameras[index],
            rgb_u8=read_color(images[index], size),
            tissue_mask=~read_tool_mask(masks[index], described.get("mask_tool_value", 255), size),
            depth=depth,
            depth_valid=depth_valid,
        )
        return shrunk(frame, cfg.shrink)

    truth = None
    if (path / "truth").is_dir():
        truth = Truth(path / "truth", [file.stem for file in images])
        if cfg.shrink > 1 or count < len(images):
            truth = None
            remarks.append(f"{path / 'truth'}: left out, because it belongs to the whole sequence at its full size")
    description = [path / "sequence.json"] if described else []
    return Sequence(
        path,
        [shrunk_camera(camera, cfg.shrink) for camera in cameras[:count]],
        read_frame,
        frames_per_second=float(described["frames_per_second"]) if "frames_per_second" in described else None,
        mask_folder=folders[1],
        files=[*images[:count], *masks[:count], *depths[:count], path / "poses_bounds.npy", *description],
        truth=truth,
        remarks=remarks,
    )


def _list_png(folder: Path) -> list[Path]:
    """The PNG files of a folder in sorted order, runs of digits compared as numbers (2 before 10)."""

    def order(file: Path) -> list[int | str]:
        # Splitting at digits alternates text and number, so that equal positions always compare.
        return [int(part) if part.isdigit() else part for part in re.split(r"([0-9]+)", file.name)]

    if not folder.is_dir():
        raise complaint(folder, "a folder of PNG files", "no such folder", "Pass a folder in the EndoNeRF layout.")
    everything = [file for file in folder.iterdir() if not file.name.startswith(".")]
    files = [file for file in everything if file.suffix.lower() == ".png"]
    if not files:
        other = sorted({file.suffix for file in everything if file.suffix})
        got = f"none (only {', '.join(other)})" if other else "none"
        raise complaint(folder, "PNG files", got, "Put one PNG per frame there.")
    return sorted(files, key=order)


def _unequal_names(images: list[Path], others: list[Path]) -> list[str]:
    """A remark when files matched by order share no number in their names, else nothing."""
    for image, other in zip(images, others, strict=True):
        numbers = [{int(digits) for digits in re.findall(r"[0-9]+", file.stem)} for file in (image, other)]
        if all(numbers) and numbers[0].isdisjoint(numbers[1]):
            return [f"{other}: matched by order with {image.name}, whose number differs; a frame may be missing"]
    return []


def _read_description(path: Path) -> dict[str, Any]:
    """The checked contents of `sequence.json`, or an empty dict when there is none."""
    if not path.exists():
        return {}
    try:
        described = json.loads(path.read_text(encoding="utf-8"))
    except (OSError, ValueError) as error:
        raise complaint(path, "a JSON object", str(error).split("\n")[0], "Correct it or remove it.") from None
    if not isinstance(described, dict):
        raise complaint(path, "a JSON object", type(described).__name__, "Correct it or remove it.")
    described = {key: value for key, value in described.items() if value is not None}
    for key in ("fx", "fy", "cx", "cy", "width", "height", "depth_scale", "frames_per_second"):
        value = described.get(key, 1)
        if isinstance(value, bool) or not isinstance(value, int | float) or not (math.isfinite(value) and value > 0):
            raise complaint(path, f"{key} to be a number > 0", repr(value), "Correct it or remove it.")
    if described.get("depth_unit", "mm") != "mm":
        hint = "Give mm, and mm per stored unit as depth_scale."
        raise complaint(path, "depth_unit mm", repr(described["depth_unit"]), hint)
    if described.get("mask_tool_value", 255) not in (0, 255):
        hint = "Say which of the two marks tools."
        raise complaint(path, "mask_tool_value 255 or 0", repr(described["mask_tool_value"]), hint)
    return described


def _read_poses(path: Path, num_frames: int) -> NDArray[np.float64]:
    """(N, 3, 5) camera-to-world [R | t | (height, width, focal)] from `poses_bounds.npy`, checked."""
    hint = "Write one row of 17 numbers per frame: 3x5 [R | t | (H, W, focal)], near, far."
    if not path.exists():
        raise complaint(path, "camera poses", "no such file", hint)
    try:
        with path.open("rb") as file:
            stored = np.load(file, allow_pickle=False)
    except (OSError, ValueError, EOFError, BadZipFile) as error:
        raise complaint(path, "a NumPy array", str(error).split("\n")[0], hint) from None
    if not isinstance(stored, np.ndarray) or stored.shape != (num_frames, 17):
        raise complaint(path, f"shape ({num_frames}, 17)", str(getattr(stored, "shape", "an archive")), hint)
    if not np.issubdtype(stored.dtype, np.number) or not np.isfinite(stored[:, :15].astype(np.float64)).all():
        raise complaint(path, "finite numbers", "NaN, infinity or other values", hint)
    poses = stored[:, :15].astype(np.float64).reshape(-1, 3, 5)
    rotations = poses[:, :, :3]
    deviation = np.abs(rotations.transpose(0, 2, 1) @ rotations - np.eye(3)).max((1, 2))
    wrong = np.flatnonzero((deviation > ROTATION_TOLERANCE) | (np.linalg.det(rotations) <= 0))
    if wrong.size:
        raise complaint(path, "rotations in columns 0-2", f"something else in row {wrong[0]}", hint)
    return poses


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
    stored_height, stored_width, focal = poses[0, :, 4]
    if "fx" not in described and focal <= 0:
        raise complaint(path / "poses_bounds.npy", "a focal length > 0 px", f"{focal:g}", "Correct row 0, column 14.")
    if {"width", "height"} <= described.keys() and (described["width"], described["height"]) != (width, height):
        got = f"{described['width']}x{described['height']}"
        hint = "Scale fx, fy, cx, cy to the images, or remove the file."
        raise complaint(path / "sequence.json", f"the images' size {width}x{height}", got, hint)
    if "fx" not in described and (stored_width, stored_height) != (width, height):
        remarks.append(
            f"{path / 'poses_bounds.npy'}: its focal length is for {stored_width:g}x{stored_height:g} px, "
            f"the images are {width}x{height}; it is used as it stands"
        )
    fx = float(described.get("fx", focal))
    intrinsics = (
        fx,
        float(described.get("fy", fx)),
        float(described.get("cx", width / 2)),
        float(described.get("cy", height / 2)),
    )
    flip = np.array([1.0, 1.0, 1.0] if pose_axes == "opencv" else [1.0, -1.0, -1.0])
    cameras = []
    for pose in poses:
        world_to_camera = np.eye(4)
        rotation = (pose[:, :3] * flip).T
        world_to_camera[:3, :3] = rotation
        world_to_camera[:3, 3] = -rotation @ pose[:, 3]
        cameras.append(Camera(width, height, *intrinsics, world_to_camera))
    return cameras
