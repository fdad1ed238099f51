"""Reader of plain folders: images, with masks, depth and poses if there are any; else the camera is static."""

from __future__ import annotations

from pathlib import Path

import numpy as np

from ..core.config import DataConfig
from ..core.types import Camera
from .assemble import Pixels, assemble, kept_frames
from .camera_matrix import MATRIX_FILE, read_camera_matrix
from .depth_files import DEPTH_SUFFIXES, read_depth_file
from .description import check_frames, intrinsics_of, read_description
from .endonerf import focal_at, read_poses_bounds
from .files import IMAGE_SUFFIXES, list_files
from .formats import Format
from .frame_files import files_of_images
from .images import read_color, read_tool_mask
from .poses import identity_poses, world_to_camera
from .right_eye import open_right_eye
from .sequence import FrameSequence
from .series import one_per_frame

FACTS = ("sequence.json", "poses_bounds.npy", MATRIX_FILE)
"""Files beside those of the frames."""
ASSUMED_FOCAL = 0.9
"""Focal length in image widths if none is given: a field of view of 58 degrees, typical of endoscopes."""


def is_plain(path: Path) -> bool:
    """Whether a folder has images in `images/`."""
    folder = path / "images"
    return folder.is_dir() and any(file.suffix.lower() in IMAGE_SUFFIXES for file in folder.iterdir())


def load_plain(path: Path, cfg: DataConfig) -> FrameSequence:
    """Open a folder of images. A remark names everything that is missing and assumed.

    Raises:
        InputError: no images, numbers of files that differ, or files that cannot be used.
    """
    listed = list_files(path / "images", IMAGE_SUFFIXES, "plain")
    images, note = one_per_frame(path / "images", listed, "images")
    mask_folder = "gt_masks" if cfg.use_gt_masks else "masks"
    # A folder that the user names must exist.
    masked = cfg.use_gt_masks or (path / mask_folder).is_dir()
    masks = list_files(path / mask_folder, (".png",), "plain") if masked else []
    depths = list_files(path / "depth", DEPTH_SUFFIXES, "plain") if (path / "depth").is_dir() else []
    remarks = [note] if note else []
    masks = files_of_images(path / mask_folder, masks, "masks", images, remarks) if masks else {}
    depths = files_of_images(path / "depth", depths, "depth", images, remarks) if depths else {}
    described = read_description(path / "sequence.json")
    remarks += check_frames(path / "sequence.json", described, len(images))
    if not masks:
        remarks.append(f"{path / 'masks'}: missing, every pixel counts as tissue")
    if not depths:
        remarks.append(f"{path / 'depth'}: missing; endoprior prepare adds it")
    unit = cfg.depth_unit_mm or described.get("depth_scale")
    if depths and not unit:
        remarks.append(f"{path / 'depth'}: no unit given, mm assumed; set data.depth_unit_mm")
    height, width = read_color(images[0]).shape[:2]
    calibration = path / MATRIX_FILE
    if "fx" not in described and calibration.is_file():
        matrix = read_camera_matrix(calibration)
        described |= {"fx": matrix[0, 0], "fy": matrix[1, 1], "cx": matrix[0, 2], "cy": matrix[1, 2]}
    kept = [i for i in kept_frames(len(images), cfg) if all(i in files for files in (masks, depths) if files)]
    focal, poses = ASSUMED_FOCAL * width, identity_poses(len(images))
    if (path / "poses_bounds.npy").exists():
        stored = read_poses_bounds(path / "poses_bounds.npy", len(images))
        poses = [world_to_camera(pose[:, :3], pose[:, 3]) for pose in stored]
        if "fx" not in described:
            focal = focal_at(path / "poses_bounds.npy", stored[0, :, 4], width, height, remarks)
    else:
        remarks.append(f"{path}: no camera poses, the camera is assumed to be static")
        if "fx" not in described:
            remarks.append(f"{path}: no focal length given, {ASSUMED_FOCAL:g} image widths ({focal:g} px) are assumed")
    shape = (width, height, *intrinsics_of(path / "sequence.json", described, width, height, focal))
    new_masks = [] if masks or len(kept) < len(images) else [path / "masks" / f"{image.stem}.png" for image in images]
    size, tool_value = (width, height), described.get("mask_tool_value", 255)
    relative = described.get("depth_relative", not unit)
    right_eye = open_right_eye(path, images, kept, size, described, cfg.shrink, remarks, relative=relative)
    images, masks, depths = ([files[i] for i in kept] if files else [] for files in (images, masks, depths))

    def decode(index: int) -> Pixels:
        tool = read_tool_mask(masks[index], tool_value, size) if masks else np.zeros((height, width), bool)
        blank = np.zeros((height, width), np.float32)
        depth = read_depth_file(depths[index], unit or 1.0, size) if depths else blank
        return read_color(images[index], size), ~tool, depth

    rate = described.get("frames_per_second")
    return assemble(
        path,
        cfg,
        [Camera(*shape, poses[i]) for i in kept],
        decode,
        images=images,
        files=[*masks, *depths, *(path / name for name in FACTS if (path / name).exists())],
        frames_per_second=float(rate) / (cfg.stride or 1) if rate is not None else None,
        right_eye=right_eye,
        remarks=remarks,
        mask_folder=mask_folder,
        mask_files=masks,
        new_mask_files=new_masks,
        mask_tool_value=tool_value,
        depth_is_relative=relative,
        sources=described.get("sources"),
    )


FORMAT = Format(is_plain, load_plain)
