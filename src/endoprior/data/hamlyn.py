"""Reader of Hamlyn sequences: Forplane's selection, and the rectified videos of Endo-Depth-and-Motion.

None has camera poses: the camera is assumed to be static. Rectification leaves a black margin, which is no tissue.
"""

from __future__ import annotations

import re
from itertools import chain
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from ..core.config import DataConfig
from ..core.ranges import evenly_spaced
from ..core.types import Camera
from ..footage.border import find_outside
from .assemble import Pixels, assemble, kept_frames
from .files import IMAGE_SUFFIXES, list_files
from .formats import DatasetFormat
from .frame_files import Kind, files_of_images
from .images import read_color, read_depth_file, read_tool_mask
from .poses import MATRIX_FILE, POSES, focal_at, identity_poses, matrix_of_images, read_camera_matrix, read_poses_bounds
from .sequence import FrameSequence

FULL_SIZE = (640, 480)
"""(width, height) to which Forplane and EndoGaussian bring every image; that of their `intrinsics.txt`."""
CROPPED_PX = 40  # empty columns at the left of such an image; their programs crop them, too
SAMPLES = 20  # images in which a margin must be black
RECTIFIED = (("image01", "depth01"), ("color", "depth"))
"""Folders of images and depth in the rectified videos: for depth networks, and for tracking."""


def load_hamlyn(path: Path, cfg: DataConfig) -> FrameSequence:
    """Open a Hamlyn sequence.

    Forplane's have `images/`, `gt_masks/` or `masks/`, depth, and a camera: `intrinsics.txt`, else `poses_bounds.npy`.
    Rectified videos have images, depth in mm and a camera matrix; no masks.
    """
    remarks: list[str] = []
    if rectified := _rectified_folders(path):
        layout, kinds, mask_folder, (image_folder, depth_folder) = "Hamlyn", IMAGE_SUFFIXES, "", rectified
    else:
        layout, kinds, image_folder = "Forplane", (".png",), "images"
        mask_folder = "gt_masks" if (path / "gt_masks").is_dir() else "masks"
        depth_folder = next((name for name in ("gt_depth", "pred_disp") if (path / name).is_dir()), "depth")
    images = list_files(path / image_folder, kinds, layout)
    kinds_of: list[tuple[str, Kind]] = [(depth_folder, "depth"), (mask_folder, "masks")]
    columns = [
        files_of_images(path / folder, list_files(path / folder, (".png",), layout), kind, images, remarks)
        for folder, kind in kinds_of
        if folder
    ]
    height, width = read_color(images[0]).shape[:2]
    size, crop = (width, height), 0
    if rectified:
        camera_file = _matrix_file(path)
        matrix = read_camera_matrix(camera_file)
        remarks.append(f"{path}: no tool masks, tools count as tissue")
    else:
        if _is_named(path) or (path / MATRIX_FILE).exists() or width * 3 == height * 4:
            crop = round(CROPPED_PX * width / FULL_SIZE[0])
            remarks.append(f"{path}: {crop} empty columns at the left are cropped, as in Forplane")
        else:
            got = f"{width}x{height} px is no Hamlyn video"
            remarks.append(f"{path}: {got}; read as EndoNeRF's, without Forplane's crop")
        matrix, camera_file = _forplane_matrix(path, size, crop, len(images), remarks)
        if depth_folder == "pred_disp":
            remarks.append(f"{path / depth_folder}: read as depth, as Forplane does, though its name says disparity")
        if not cfg.depth_unit_mm:
            remarks.append(f"{path / depth_folder}: its unit is not documented, mm assumed; set data.depth_unit_mm")
    remarks.append(f"{path}: no camera poses, the camera is assumed to be static")
    kept = kept_frames(len(images), cfg, having=columns)
    images = [images[i] for i in kept]
    depths, *masks = ([files[i] for i in kept] for files in columns)
    margin = find_outside([read_color(images[i], size)[:, crop:] for i in evenly_spaced(len(images), SAMPLES)]).mask
    if margin.any():
        remarks.append(f"{path}: a black margin, {margin.mean():.0%} of a frame, is no tissue")

    def decode(index: int) -> Pixels:
        depth = read_depth_file(depths[index], cfg.depth_unit_mm or 1.0, size)[:, crop:]
        tissue = ~margin
        for files in masks:
            tissue = tissue & ~read_tool_mask(files[index], 255, size)[:, crop:]
        color = read_color(images[index], size)[:, crop:]
        return np.ascontiguousarray(color), tissue, np.ascontiguousarray(depth)

    # The principal point moves by the whole crop; Forplane moves it by half of that, which is a different camera.
    shape = (width - crop, height, matrix[0, 0], matrix[1, 1], matrix[0, 2] - crop, matrix[1, 2])
    return assemble(
        path,
        cfg,
        [Camera(*shape, pose) for pose in identity_poses(len(kept))],
        decode,
        images=images,
        # A calibration outside the folder has no name below it, which the fingerprint needs.
        files=[*depths, *chain(*masks), *([camera_file] if camera_file.is_relative_to(path) else [])],
        remarks=remarks,
        mask_folder=mask_folder or image_folder,
        depth_is_relative=not rectified and not cfg.depth_unit_mm,
        sources={"depth": "stereo matching" if rectified else "stereo matching, by Forplane"},
    )


def _forplane_matrix(
    path: Path, size: tuple[int, int], crop: int, count: int, remarks: list[str]
) -> tuple[NDArray[np.float64], Path]:
    """(3, 3) K, px with centers at halves, of the images before the crop, and the file that it comes from."""
    width, height = size
    stored, poses = path / MATRIX_FILE, path / POSES
    if stored.exists():
        if poses.exists():
            remarks.append(f"{poses}: not used; {MATRIX_FILE} is the calibration")
        return matrix_of_images(stored, read_camera_matrix(stored), size, FULL_SIZE, remarks), stored
    # All rows must be finite, but only size and focal length are used: Forplane's camera is static.
    known = read_poses_bounds(poses, count)
    # Some files hold the size after the crop, which leaves the focal length as it is.
    across = width - crop if known[0, 1, 4] == width - crop else width
    focal = focal_at(poses, known, (across, height), remarks)
    return np.array([[focal, 0, width / 2], [0, focal, height / 2], [0, 0, 1]]), poses


def _matrix_file(path: Path) -> Path:
    """The camera matrix of a rectified video: beside its frames, or with those of the other videos."""
    number = (re.findall(r"[0-9]+", path.name) or [""])[-1]
    own = f"intrinsics_rectified{number}.txt"
    calibration = path.parent / "calibration"
    places = [path / MATRIX_FILE, path / own, path / "intrinsic" / "intrinsic_color.txt", path.parent / own]
    places += [calibration / number / MATRIX_FILE, calibration / own]
    return next((place for place in places if place.is_file()), places[0])


def _is_named(path: Path) -> bool:
    return any("hamlyn" in name.lower() for name in (path.name, path.parent.name))


def _rectified_folders(path: Path) -> tuple[str, str] | None:
    """Names of the folders of images and depth of a rectified video; None if it is none."""
    for images, depths in RECTIFIED:
        if not ((path / images).is_dir() and (path / depths).is_dir()):
            continue
        # Other RGB-D datasets have such folders, with a pose for each frame.
        if images == "image01" or (_matrix_file(path).exists() and not any(path.glob("pose*"))):
            return images, depths
    return None


def is_hamlyn(path: Path) -> bool:
    """Whether a folder is a Hamlyn sequence; Forplane's have `gt_depth/`, `pred_disp/`, or `hamlyn` in their name."""
    if _rectified_folders(path):
        return True
    own_depth = any((path / name).is_dir() for name in ("gt_depth", "pred_disp"))
    own_camera = (path / MATRIX_FILE).exists() and ((path / "gt_masks").is_dir() or _is_named(path))
    # A folder that this program prepared from a Hamlyn video has a sequence.json and no empty columns.
    bare = (path / POSES).exists() and not (path / "sequence.json").exists()
    return (path / "images").is_dir() and (own_depth or own_camera or (bare and _is_named(path)))


FORMAT = DatasetFormat(is_hamlyn, load_hamlyn)
