"""Reader of processed SCARED keyframes: rectified left images, disparity, calibration and pose of every frame.

Images are rectified; calibration and pose in `frame_data` are those before rectification. There are two versions of
processed data. Version 1 (EndoGaussian, EndoSurf) stores Q alone, which holds the rectified camera; the rotation of the
rectification is computed from the raw stereo calibration. Version 2 (EndoPrior-GS) stores rotation and camera.
Pixel centers of these calibrations are integers, ours are halves: 0.5 is added to principal points.
"""

from __future__ import annotations

import re
from pathlib import Path
from typing import Any, NamedTuple

import cv2
import numpy as np
from numpy.typing import NDArray

from ..core.checks import input_error
from ..core.config import DataConfig
from ..core.types import Camera
from .assemble import Pixels, assemble, kept_frames
from .files import list_files
from .formats import DatasetFormat
from .images import read_color, read_values
from .poses import demand_rotations
from .reading import read_json, read_matrix
from .sequence import FrameSequence

STRIDES = {1: 2, 2: 1, 3: 4, 6: 8, 7: 8}  # published frame stride of each dataset number
BADLY_CALIBRATED = (4, 5)
NEAR_MM, FAR_MM = 0.03, 300.0
"""Depth outside this range counts as missing. The near end is the published one, though probably a typo for 30."""
FOLDERS = {"left_finalpass": ".png", "disparity": ".tiff", "reprojection_data": ".json"}
HINT = "process the keyframe first, see docs/datasets.md."
RAW_STEREO = ("KL", "KR", "R", "T")
"""Raw camera matrices, and the pose of the right camera, in `camera-calibration` of a frame."""
VERSION_2 = ("left_rectification_rotation", "left_projection_matrix", "reprojection_matrix")


def is_scared(path: Path) -> bool:
    """Whether a folder is a SCARED keyframe, processed or raw."""
    names = ("data/frame_data", "data/frame_data.tar.gz", "point_cloud.obj", "left_point_cloud.obj")
    return any((path / name).exists() for name in names)


def load_scared(path: Path, cfg: DataConfig) -> FrameSequence:
    """Open a processed keyframe folder; poses are relative to the first frame."""
    data = path / "data"
    for folder in ("frame_data", *FOLDERS):
        if not (data / folder).is_dir():
            raise input_error(data / folder, "a folder of processed SCARED frames", "no such folder", HINT)
    records = list_files(data / "frame_data", (".json",), "SCARED")
    for folder, suffix in FOLDERS.items():
        others = {file.stem for file in list_files(data / folder, (suffix,), "SCARED")}
        if odd := sorted({file.stem for file in records} ^ others):
            got = f"{len(others)}; {odd[0]} is in one of the two only"
            raise input_error(data / folder, f"the {len(records)} frames of frame_data", got, HINT)
    number, remarks = dataset_number(path), []
    if number is None and not cfg.stride:
        remarks.append(f"{path}: no folder dataset_k in its path, so every frame is kept; set data.stride")
    if number in BADLY_CALIBRATED:
        remarks.append(f"{path}: dataset {number} of SCARED is badly calibrated; its depth does not fit its images")
    records = [records[i] for i in kept_frames(len(records), cfg, STRIDES.get(number or 0, 1))]
    names = [file.stem for file in records]
    images, disparities, geometries = ([data / f / f"{n}{s}" for n in names] for f, s in FOLDERS.items())
    height, width = read_color(images[0]).shape[:2]
    size = (width, height)
    geometry = [_geometry(*files, size) for files in zip(records, geometries, strict=True)]
    if len({one.version for one in geometry}) > 1:
        hint = "process all frames by the same program."
        raise input_error(data / "reprojection_data", "files of one version", "versions 1 and 2", hint)
    if not all(one.is_turned for one in geometry):
        remarks.append(f"{data}: no stereo calibration (KR, R, T): poses are not turned by the rectification")
    to_camera = np.stack([one.world_to_camera for one in geometry])
    demand_rotations(data / "frame_data", to_camera[:, :3, :3], "camera-pose", HINT)
    first_to_world = np.linalg.inv(to_camera[0])
    cameras = [
        Camera(width, height, k[0, 0], k[1, 1], k[0, 2] + 0.5, k[1, 2] + 0.5, pose @ first_to_world)
        for k, pose, *_ in geometry
    ]

    def decode(index: int) -> Pixels:
        depth = disparity_to_depth(read_values(disparities[index], size), geometry[index].reprojection)
        return read_color(images[index], size), tissue_from_depth(depth), depth

    return assemble(
        path,
        cfg,
        cameras,
        decode,
        images=images,
        files=[*disparities, *records, *geometries],
        clip_depth=False,
        remarks=remarks,
        mask_folder="data/disparity",
        sources={"depth": "structured light at the keyframe, transferred to other frames by robot kinematics"},
    )


def disparity_to_depth(disparity: NDArray[np.float32], reprojection: NDArray[np.float64]) -> NDArray[np.float32]:
    """(H, W) depth z = Q[2,3] / (Q[3,2] d + Q[3,3]) of disparity d, px, and (4, 4) Q, in mm.

    It is 0 outside [NEAR_MM, FAR_MM], and where disparity is missing: 0, negative or not finite.
    """
    known = np.isfinite(disparity) & (disparity > 0)
    below = np.where(known, reprojection[3, 2] * disparity + reprojection[3, 3], 0)
    with np.errstate(divide="ignore"):
        depth = reprojection[2, 3] / below
    return np.where(known & (depth >= NEAR_MM) & (depth <= FAR_MM), depth, 0).astype(np.float32)


def tissue_from_depth(depth: NDArray[np.float32]) -> NDArray[np.bool_]:
    """(H, W) True where depth is known, gaps closed by squares of W / 128 px; there are no tool masks.

    OpenCV's closing with an even square shifts the mask by one pixel, as in the published masks.
    """
    side = max(1, depth.shape[1] // 128)
    return cv2.morphologyEx((depth != 0).astype(np.uint8), cv2.MORPH_CLOSE, np.ones((side, side), np.uint8)) > 0


def dataset_number(path: Path) -> int | None:
    """The k of `dataset_k` among a path's folders, or of a name like `d1k1`; None without one."""
    for part in reversed(path.resolve().parts):
        if match := re.fullmatch(r"dataset_?(\d+)([_-]?keyframe_?\d+)?|d(\d+)[_-]?k\d+", part.lower()):
            return int(match[1] or match[3])
    return None


class _Geometry(NamedTuple):
    """Of one frame after rectification."""

    matrix: NDArray[np.float64]  # (3, 3) K, px, integer pixel centers
    world_to_camera: NDArray[np.float64]  # (4, 4), mm
    reprojection: NDArray[np.float64]  # (4, 4) Q
    version: int
    is_turned: bool  # whether the rotation of the rectification is known


def _geometry(record: Path, geometry: Path, size: tuple[int, int]) -> _Geometry:
    about, stored = read_json(record, HINT), read_json(geometry, HINT)
    pose = read_matrix(record, about, "camera-pose", (4, 4))
    version = stored.get("schema_version", 2 if VERSION_2[0] in stored else 1)
    if type(version) is not int or version not in (1, 2):
        raise input_error(geometry, "schema_version 1 or 2", repr(version), HINT)
    if version == 1:
        reprojection = read_matrix(geometry, stored, "reprojection-matrix", (4, 4))
        focal, cx, cy = reprojection[2, 3], -reprojection[0, 3], -reprojection[1, 3]
        matrix = np.array([[focal, 0, cx], [0, focal, cy], [0, 0, 1]])
        rotation = _rectifying_rotation(record, about, size)
    else:
        rotation = read_matrix(geometry, stored, VERSION_2[0], (3, 3))
        matrix = read_matrix(geometry, stored, VERSION_2[1], (3, 4))[:, :3]
        reprojection = read_matrix(geometry, stored, VERSION_2[2], (4, 4))
        if stored.get("image_size", list(size)) != list(size):
            raise input_error(geometry, f"image_size {list(size)} like the image", f"{stored['image_size']}", HINT)
    if min(matrix[0, 0], matrix[1, 1]) <= 0:
        raise input_error(geometry, "focal lengths > 0 px", f"{matrix[0, 0]:g}, {matrix[1, 1]:g}", HINT)
    if rotation is not None:
        pose[:3] = rotation @ pose[:3]
    return _Geometry(matrix, pose, reprojection, version, rotation is not None)


def _rectifying_rotation(record: Path, about: dict[str, Any], size: tuple[int, int]) -> NDArray[np.float64] | None:
    """(3, 3) from axes of the raw left camera to those of the rectified one; None if the right camera is not known.

    Bouguet's method, as `cv2.stereoRectify` has it: it follows from the pose of the right camera alone.
    """
    calibration = about.get("camera-calibration")
    if not isinstance(calibration, dict) or any(key not in calibration for key in RAW_STEREO):
        return None
    left, right, turn = (read_matrix(record, about, f"camera-calibration.{key}", (3, 3)) for key in RAW_STEREO[:3])
    stored = calibration["T"]
    if isinstance(stored, list) and all(isinstance(row, list) and len(row) == 1 for row in stored):
        stored = [row[0] for row in stored]  # a column
    rows = stored if isinstance(stored, list) and len(stored) == 1 else [stored]
    shift = read_matrix(record, {"T": rows}, "T", (1, 3))[0]
    if not shift.any():
        raise input_error(record, "a right camera beside the left one", "T of 0 mm", HINT)
    straight = np.zeros(5)
    return np.asarray(cv2.stereoRectify(left, straight, right, straight, size, turn, shift[:, None])[0], np.float64)


FORMAT = DatasetFormat(is_scared, load_scared)
