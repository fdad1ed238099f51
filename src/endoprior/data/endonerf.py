"""Reader of the EndoNeRF layout, `images/ masks/ depth/ poses_bounds.npy sequence.json`, and of folders with less.

Prepared StereoMIS sequences have `split.json` besides, as EndoPrior-GS writes it; raw ones are recognized only to
explain how to prepare them. Cheap facts (counts, poses, the description) are checked on loading, files when they are
decoded. `N` frames.
"""

from __future__ import annotations

from pathlib import Path
from typing import Any, Literal

import numpy as np
from numpy.typing import NDArray

from ..core.checks import input_error
from ..core.config import DataConfig
from ..core.shell import command
from ..core.types import Camera
from .assemble import Pixels, assemble, kept_frames
from .description import frame_weights, intrinsics_of, read_description
from .files import CONFIDENCE, IMAGE_SUFFIXES, list_files, read_json
from .formats import DatasetFormat
from .frame_files import Kind, files_of_images, missing_numbers, one_per_frame
from .images import (
    DEPTH_SUFFIXES,
    decode_image,
    read_color,
    read_depth,
    read_depth_file,
    read_share,
    read_tool_mask,
    read_values,
)
from .poses import MATRIX_FILE, demand_rotations, identity_poses, read_camera_matrix, scale_of, world_to_camera
from .reading import read_numpy
from .scale import described_scale
from .sequence import FrameSequence, is_test_frame
from .truth import Truth, open_right_eye

POSES = "poses_bounds.npy"
POSES_HINT = "write one row of 17 numbers per frame: 3x5 [R | t | (H, W, focal)], near, far."
STILL_HINT = f"{POSES_HINT[:-1]}; for a static camera, set data.format to plain."
ASSUMED_FOCAL = 0.9
"""Focal length in image widths if none is given: a field of view of 58 degrees, typical of endoscopes."""
RAW_STEREOMIS = "StereoCalibration.ini"


def load_endonerf(
    path: Path,
    cfg: DataConfig,
    *,
    pose_axes: Literal["opencv", "opengl"] = "opencv",
    facts: dict[str, Any] | None = None,
    fact_files: list[Path] | None = None,
    complete: bool = True,
) -> FrameSequence:
    """Open a folder in the EndoNeRF layout.

    Args:
        path: the folder.
        cfg: which frames and masks are read and how depth is cleaned.
        pose_axes: meaning of the columns of the stored camera-to-world matrices: `opencv` (x right, y down,
            z forward; as stored by EndoNeRF) or `opengl` (x right, y up, z backward).
        facts: entries of `sequence.json` that a dataset has elsewhere; the file itself overrides them.
        fact_files: the files they come from.
        complete: masks, depth and poses must be there, as PNG; see `load_plain`.
    """
    layout, kinds = ("EndoNeRF", (".png",)) if complete else ("plain", IMAGE_SUFFIXES)
    remarks: list[str] = []
    images, note = one_per_frame(path / "images", list_files(path / "images", kinds, layout), "images")
    if len(images) < 2:
        raise input_error(path / "images", "at least 2 frames, 1 to train and 1 to test", "1", "add frames.")
    missing = missing_numbers(images)
    remarks += [each for each in (note, missing and f"{path / 'images'}: {missing}") if each]

    def column(name: str, kind: Kind, suffixes: tuple[str, ...], required: bool, missing: str) -> dict[int, Path]:
        """The file of each image in a folder."""
        if required or (path / name).is_dir():
            return files_of_images(path / name, list_files(path / name, suffixes, layout), kind, images, remarks)
        remarks.append(f"{path / name}: missing{missing}")
        return {}

    mask_folder = "gt_masks" if cfg.use_gt_masks else "masks"
    # A folder that the user names must exist.
    masks = column(mask_folder, "masks", (".png",), complete or cfg.use_gt_masks, ", every pixel counts as tissue")
    kinds = (".png",) if complete else DEPTH_SUFFIXES
    depths = column("depth", "depth", kinds, complete, "; endoprior prepare adds it")
    described = (facts or {}) | read_description(path / "sequence.json")
    weights = frame_weights(path / "sequence.json", described, len(images))
    unit = cfg.depth_unit_mm or described.get("depth_scale")
    if depths and not unit and not complete:
        remarks.append(f"{path / 'depth'}: no unit given, mm assumed; set data.depth_unit_mm")
    height, width = read_color(images[0]).shape[:2]
    size = (width, height)
    cameras = _cameras(path, described, size, len(images), pose_axes, remarks, complete=complete)
    kept = kept_frames(len(images), cfg, having=[files for files in (masks, depths) if files or complete])
    relative = described.get("depth_relative", not unit and not complete)
    right_eye = open_right_eye(path, images, kept, size, described, cfg.shrink, remarks, relative=relative)
    new_masks = [] if masks or len(kept) < len(images) else [path / "masks" / f"{image.stem}.png" for image in images]
    images = [images[i] for i in kept]
    mask_files, depth_files = ([files[i] for i in kept] if files else [] for files in (masks, depths))
    sureness = [path / CONFIDENCE / f"{image.stem}.png" for image in images]
    sureness = sureness if cfg.reliability == "used" and depths and (path / CONFIDENCE).is_dir() else []
    tool_value = described.get("mask_tool_value", 255)

    def decode(index: int) -> Pixels:
        tissue, depth = np.ones((height, width), bool), np.zeros((height, width), np.float32)
        if mask_files:
            tissue = ~read_tool_mask(mask_files[index], tool_value, size)
        if depth_files:
            depth = (read_depth if complete else read_depth_file)(depth_files[index], unit or 1.0, size)
        return read_color(images[index], size), tissue, depth

    truth = None
    if complete and (path / "truth").is_dir():
        if cfg.shrink > 1 or len(kept) < len(cameras):
            remarks.append(f"{path / 'truth'}: ignored, because it belongs to the whole sequence at full size")
        else:
            truth = Truth(path / "truth", [file.stem for file in images])
    rate = described.get("frames_per_second")
    facts_here = [path / name for name in ("sequence.json", POSES, *([] if complete else [MATRIX_FILE]))]
    return assemble(
        path,
        cfg,
        [cameras[i] for i in kept],
        decode,
        images=images,
        files=[*mask_files, *depth_files, *sureness, *filter(Path.exists, facts_here), *(fact_files or [])],
        frames_per_second=float(rate) / (cfg.stride or 1) if rate is not None else None,
        truth=truth,
        right_eye=right_eye,
        remarks=remarks,
        mask_folder=mask_folder,
        mask_files=mask_files,
        new_mask_files=new_masks,
        mask_tool_value=tool_value,
        depth_is_relative=relative,
        scale=described_scale(path / "sequence.json", described),
        sources=described.get("sources") or {},
        frame_weights=weights[kept],
        confidence=(lambda index: read_share(sureness[index], size)) if sureness else None,
    )


def load_plain(path: Path, cfg: DataConfig) -> FrameSequence:
    """Open a folder of images, with masks, depth and poses if there are any; else the camera is static.

    A remark names everything that is missing and assumed.
    """
    return load_endonerf(path, cfg, complete=False)


def _cameras(
    path: Path,
    described: dict[str, Any],
    size: tuple[int, int],
    count: int,
    pose_axes: Literal["opencv", "opengl"],
    remarks: list[str],
    *,
    complete: bool,
) -> list[Camera]:
    """One camera per frame. Intrinsics come from `sequence.json` where it has them, else from row 0 of the poses."""
    width, height = size
    if not complete and "fx" not in described and (path / MATRIX_FILE).is_file():
        matrix = read_camera_matrix(path / MATRIX_FILE)
        described |= {"fx": matrix[0, 0], "fy": matrix[1, 1], "cx": matrix[0, 2], "cy": matrix[1, 2]}
    focal, poses = ASSUMED_FOCAL * width, identity_poses(count)
    if complete or (path / POSES).exists():
        stored = read_poses_bounds(path / POSES, count)
        flip = np.array([1.0, 1.0, 1.0] if pose_axes == "opencv" else [1.0, -1.0, -1.0])
        poses = [world_to_camera(pose[:, :3] * flip, pose[:, 3]) for pose in stored]
        if "fx" not in described:
            focal = focal_at(path / POSES, stored, size, remarks)
    else:
        remarks.append(f"{path}: no camera poses, the camera is assumed to be static")
        if "fx" not in described:
            remarks.append(f"{path}: no focal length given, {ASSUMED_FOCAL:g} image widths ({focal:g} px) are assumed")
    intrinsics = intrinsics_of(path / "sequence.json", described, width, height, focal)
    return [Camera(width, height, *intrinsics, pose) for pose in poses]


def read_poses_bounds(path: Path, num_frames: int) -> NDArray[np.float64]:
    """(N, 3, 5) camera-to-world [R | t | (height, width, focal)] from `poses_bounds.npy`, checked."""
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


def focal_at(path: Path, poses: NDArray[np.float64], size: tuple[int, int], remarks: list[str]) -> float:
    """Focal length, px, of images of that (width, height), from the first of the stored poses of `poses_bounds.npy`."""
    height, width, focal = poses[0, :, 4].tolist()
    if focal <= 0:
        raise input_error(path, "a focal length > 0 px", f"{focal:g}", "correct row 0, column 14.")
    fix = "write the size and focal length of these images there, or fx, fy, cx, cy into sequence.json."
    return focal * scale_of(path, (width, height), size, focal, fix, remarks)


def load_stereomis(path: Path, cfg: DataConfig) -> FrameSequence:
    """Open a prepared StereoMIS sequence; poses are in mm and masks mark tools.

    8-bit depth is Omnidata's relative depth of unknown scale; 16-bit depth is in mm.
    """
    if not (path / "images").is_dir():
        videos = sorted(path.glob("*.mp4"))
        options: list[str | Path] = ["--calibration", path / RAW_STEREOMIS, "--layout", "top-bottom"]
        options += ["--masks", path / "masks", "--mask-tool-value", "low"] if (path / "masks").is_dir() else []
        options += ["--poses", path / "groundtruth.txt"] if (path / "groundtruth.txt").is_file() else []
        fix = command("prepare", videos[0] if videos else path / "VIDEO.mp4", "OUT", *options)
        raise input_error(path / RAW_STEREOMIS, "a prepared sequence", "a raw one", f"`{fix}`.")
    files = list_files(path / "images", (".png",), "StereoMIS")
    count = len(files)
    _check_split(path / "split.json", count)
    for folder in (path / ("gt_masks" if cfg.use_gt_masks else "masks"), path / "depth"):
        files = list_files(folder, (".png",), "StereoMIS")
        if len(files) != count:  # frames that are left out would move the published split
            fix = "add the missing files, or remove split.json to read the frames that have all."
            raise input_error(folder, f"{count} files, one per image", f"{len(files)}", fix)
    facts: dict[str, Any] = {}
    if decode_image(files[0], None).dtype == np.uint8:
        facts = {"depth_relative": True, "sources": {"depth": "Omnidata, relative, 8 bits"}}
    fact_files, lens = [path / "split.json"], path / "intrinsics.npy"
    if lens.exists():
        fact_files.append(lens)
        matrix = read_values(lens)
        if matrix.shape != (3, 3) or not np.isfinite(matrix).all() or min(matrix[0, 0], matrix[1, 1]) <= 0:
            hint = "write the 3x3 camera matrix of the rectified images."
            raise input_error(lens, "a 3x3 camera matrix", f"shape {matrix.shape} or other numbers", hint)
        fx, fy, cx, cy = (float(matrix[i, j]) for i, j in ((0, 0), (1, 1), (0, 2), (1, 2)))
        facts |= {"fx": fx, "fy": fy, "cx": cx + 0.5, "cy": cy + 0.5}  # pixel centers of the file are integers
    return load_endonerf(path, cfg, facts=facts, fact_files=fact_files)


def _check_split(path: Path, count: int) -> None:
    """Raise InputError if the stored split is not the one that this program uses."""
    split = read_json(path)
    for key, tests in (("test_indices", True), ("train_indices", False)):
        stored, indices = split.get(key), [i for i in range(count) if is_test_frame(i) == tests]
        if not isinstance(stored, list):
            raise input_error(path, f"a list {key}", repr(stored), "prepare the sequence again.")
        if stored != indices:
            want = f"{key} of the rule (i - 1) % 8 == 0, {len(indices)} frames"
            raise input_error(path, want, f"{len(stored)} frames that differ", "remove split.json to use that rule.")


def is_endonerf(path: Path) -> bool:
    """Whether a folder has stored poses, or PNG files in the three folders that belong to them."""
    return (path / POSES).exists() or all(any((path / name).glob("*.png")) for name in ("images", "masks", "depth"))


def is_stereomis(path: Path) -> bool:
    """Whether a folder is a StereoMIS sequence, prepared or raw."""
    return (path / RAW_STEREOMIS).exists() or ((path / "split.json").exists() and (path / "images").is_dir())


def is_without_depth(path: Path) -> bool:
    """Whether a prepared folder has poses and no depth; that of others may have depth under another name."""
    written = all((path / name).is_file() for name in (POSES, "sequence.json"))
    return written and (path / "images").is_dir() and not (path / "depth").exists()


def is_plain(path: Path) -> bool:
    """Whether a folder has images in `images/`."""
    folder = path / "images"
    return folder.is_dir() and any(file.suffix.lower() in IMAGE_SUFFIXES for file in folder.iterdir())


FORMAT = DatasetFormat(is_endonerf, load_endonerf)
STEREOMIS = DatasetFormat(is_stereomis, load_stereomis)
NO_DEPTH = DatasetFormat(is_without_depth, load_plain)  # what `prepare --depth none` leaves, to add depth to
PLAIN = DatasetFormat(is_plain, load_plain)
