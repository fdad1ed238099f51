"""Reader of the EndoNeRF layout, `images/ masks/ depth/ poses_bounds.npy sequence.json`, and of folders with less.

Prepared StereoMIS sequences have `split.json` besides, as EndoPrior-GS writes it; raw ones are recognized only to
explain how to prepare them. Cheap facts (counts, poses, the description) are checked on loading, files when they are
decoded. `N` frames.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
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
from .files import CONFIDENCE, IMAGE_SUFFIXES, list_files
from .formats import DatasetFormat
from .frame_files import Kind, files_of_images, missing_numbers, one_per_frame
from .images import (
    DEPTH_SUFFIXES,
    Size,
    decode_image,
    read_color,
    read_depth,
    read_depth_file,
    read_share,
    read_tool_mask,
)
from .poses import (
    MATRIX_FILE,
    POSES,
    focal_at,
    identity_poses,
    lens_entries,
    read_camera_matrix,
    read_poses_bounds,
    world_to_camera,
)
from .reading import read_json
from .scale import described_scale
from .sequence import FrameSequence, is_test_frame
from .truth import Truth, open_right_eye

ASSUMED_FOCAL = 0.9
"""Focal length in image widths if none is given: a field of view of 58 degrees, typical of endoscopes."""
RAW_STEREOMIS = "StereoCalibration.ini"
PoseAxes = Literal["opencv", "opengl"]


@dataclass(frozen=True)
class Layout:
    """A folder of images, masks, depth and poses: which of them it must have, and how they are stored."""

    name: str
    image_suffixes: tuple[str, ...]
    depth_suffixes: tuple[str, ...]
    read_depth: Callable[[Path, float, Size], NDArray[np.float32]]
    """Depth, mm, of a file, of its number of mm per unit, and of the images' (width, height)."""
    required: tuple[str, ...] = ()
    """What must be there, of `masks`, `depth` and `POSES`. Without masks every pixel counts as tissue, without poses
    the camera is static."""
    lens_file: str | None = None
    """A camera matrix that counts where `sequence.json` has no focal length."""
    depth_is_mm: bool = False
    """Depth without a unit is in mm; else its scale is unknown."""
    has_truth: bool = False
    """`truth/` is read."""


ENDONERF = Layout(
    "EndoNeRF", (".png",), (".png",), read_depth, ("masks", "depth", POSES), depth_is_mm=True, has_truth=True
)
IMAGES_ALONE = Layout("plain", IMAGE_SUFFIXES, DEPTH_SUFFIXES, read_depth_file, lens_file=MATRIX_FILE)


def load_endonerf(
    path: Path,
    cfg: DataConfig,
    *,
    pose_axes: PoseAxes = "opencv",
    facts: dict[str, Any] | None = None,
    fact_files: Sequence[Path] = (),
) -> FrameSequence:
    """Open a folder in the EndoNeRF layout.

    Args:
        path: the folder.
        cfg: which frames and masks are read and how depth is cleaned.
        pose_axes: meaning of the columns of the stored camera-to-world matrices: `opencv` (x right, y down,
            z forward; as stored by EndoNeRF) or `opengl` (x right, y up, z backward).
        facts: entries of `sequence.json` that a dataset has elsewhere; the file itself overrides them.
        fact_files: the files they come from.
    """
    return _load(path, cfg, ENDONERF, pose_axes, facts, fact_files)


def load_plain(path: Path, cfg: DataConfig) -> FrameSequence:
    """Open a folder of images, with masks, depth and poses if there are any; else the camera is static.

    A remark names everything that is missing and assumed.
    """
    return _load(path, cfg, IMAGES_ALONE)


def _load(
    path: Path,
    cfg: DataConfig,
    layout: Layout,
    pose_axes: PoseAxes = "opencv",
    facts: dict[str, Any] | None = None,
    fact_files: Sequence[Path] = (),
) -> FrameSequence:
    """Open a folder in a layout; the other arguments are those of `load_endonerf`."""
    remarks: list[str] = []
    found = _find_files(path, cfg, layout, remarks)
    description = path / "sequence.json"
    described = (facts or {}) | read_description(description)
    weights = frame_weights(description, described, len(found.images))
    unit = cfg.depth_unit_mm or described.get("depth_scale")
    scale_is_unknown = not unit and not layout.depth_is_mm
    if found.depths and scale_is_unknown:
        remarks.append(f"{path / 'depth'}: no unit given, mm assumed; set data.depth_unit_mm")
    height, width = read_color(found.images[0]).shape[:2]
    size = (width, height)
    cameras = _cameras(path, layout, described, size, len(found.images), pose_axes, remarks)
    kept = found.kept(cfg, layout)
    relative = described.get("depth_relative", scale_is_unknown)
    right_eye = open_right_eye(path, found.images, kept, size, described, cfg.shrink, remarks, relative=relative)
    frames, tool_value = _kept_files(path, cfg, found, kept), described.get("mask_tool_value", 255)
    rate = described.get("frames_per_second")
    facts_here = [path / name for name in ("sequence.json", POSES, layout.lens_file) if name]
    return assemble(
        path,
        cfg,
        [cameras[i] for i in kept],
        _decoder(frames, layout, size, unit or 1.0, tool_value),
        images=frames.images,
        files=[*frames.masks, *frames.depths, *frames.confidence, *filter(Path.exists, facts_here), *fact_files],
        frames_per_second=float(rate) / (cfg.stride or 1) if rate is not None else None,
        truth=_open_truth(path, cfg, frames, len(cameras), remarks) if layout.has_truth else None,
        right_eye=right_eye,
        remarks=remarks,
        mask_folder=_mask_folder(cfg),
        mask_files=frames.masks,
        new_mask_files=_new_mask_files(path, found, kept),
        mask_tool_value=tool_value,
        depth_is_relative=relative,
        scale=described_scale(description, described),
        sources=described.get("sources") or {},
        frame_weights=weights[kept],
        confidence=(lambda index: read_share(frames.confidence[index], size)) if frames.confidence else None,
    )


@dataclass(frozen=True)
class _FoundFiles:
    """The files of a folder. Masks and depths by position of their image; empty where the folder has none."""

    images: list[Path]
    masks: dict[int, Path]
    depths: dict[int, Path]

    def kept(self, cfg: DataConfig, layout: Layout) -> list[int]:
        """Positions of the images to read: those that the config selects, with a mask and depth where others have."""
        parts = {"masks": self.masks, "depth": self.depths}
        having = [files for name, files in parts.items() if files or name in layout.required]
        return kept_frames(len(self.images), cfg, having=having)


@dataclass(frozen=True)
class _KeptFiles:
    """The files of each frame that is read; empty where the folder has none."""

    images: list[Path]
    masks: list[Path]
    depths: list[Path]
    confidence: list[Path]


def _mask_folder(cfg: DataConfig) -> str:
    return "gt_masks" if cfg.use_gt_masks else "masks"


def _find_files(path: Path, cfg: DataConfig, layout: Layout, remarks: list[str]) -> _FoundFiles:
    """Which files a folder has; `remarks` gets what is missing or left out."""
    folder = path / "images"
    images, note = one_per_frame(folder, list_files(folder, layout.image_suffixes, layout.name), "images")
    if len(images) < 2:
        raise input_error(folder, "at least 2 frames, 1 to train and 1 to test", "1", "add frames.")
    missing = missing_numbers(images)
    remarks += [each for each in (note, missing and f"{folder}: {missing}") if each]
    # A folder that the user names must exist.
    required = (*layout.required, "masks") if cfg.use_gt_masks else layout.required

    def files_in(folder: Path, kind: Kind, suffixes: tuple[str, ...], without: str) -> dict[int, Path]:
        """The file of each image in a folder."""
        if kind in required or folder.is_dir():
            return files_of_images(folder, list_files(folder, suffixes, layout.name), kind, images, remarks)
        remarks.append(f"{folder}: missing{without}")
        return {}

    masks = files_in(path / _mask_folder(cfg), "masks", (".png",), ", every pixel counts as tissue")
    depths = files_in(path / "depth", "depth", layout.depth_suffixes, "; endoprior prepare adds it")
    return _FoundFiles(images, masks, depths)


def _kept_files(path: Path, cfg: DataConfig, found: _FoundFiles, kept: list[int]) -> _KeptFiles:
    """The files of the kept frames."""
    images = [found.images[i] for i in kept]
    masks, depths = ([files[i] for i in kept] if files else [] for files in (found.masks, found.depths))
    folder = path / CONFIDENCE
    is_used = cfg.reliability == "used" and bool(found.depths) and folder.is_dir()
    return _KeptFiles(images, masks, depths, [folder / f"{image.stem}.png" for image in images] if is_used else [])


def _new_mask_files(path: Path, found: _FoundFiles, kept: list[int]) -> list[Path]:
    """Where masks can be added: for a folder without any, of which every frame is read."""
    if found.masks or len(kept) < len(found.images):
        return []
    return [path / "masks" / f"{image.stem}.png" for image in found.images]


def _decoder(
    files: _KeptFiles, layout: Layout, size: Size, mm_per_unit: float, tool_value: int
) -> Callable[[int], Pixels]:
    """Reads the pixels of kept frame i."""
    width, height = size

    def decode(index: int) -> Pixels:
        tissue, depth = np.ones((height, width), bool), np.zeros((height, width), np.float32)
        if files.masks:
            tissue = ~read_tool_mask(files.masks[index], tool_value, size)
        if files.depths:
            depth = layout.read_depth(files.depths[index], mm_per_unit, size)
        return read_color(files.images[index], size), tissue, depth

    return decode


def _open_truth(path: Path, cfg: DataConfig, files: _KeptFiles, count: int, remarks: list[str]) -> Truth | None:
    """The truth of a folder of `count` frames; None, with a remark, where it does not fit those that are read."""
    folder = path / "truth"
    if not folder.is_dir():
        return None
    if cfg.shrink > 1 or len(files.images) < count:
        remarks.append(f"{folder}: ignored, because it belongs to the whole sequence at full size")
        return None
    return Truth(folder, [file.stem for file in files.images])


def _cameras(
    path: Path,
    layout: Layout,
    described: dict[str, Any],
    size: Size,
    count: int,
    pose_axes: PoseAxes,
    remarks: list[str],
) -> list[Camera]:
    """One camera per frame. Intrinsics come from `sequence.json` where it has them, else from row 0 of the poses."""
    width, height = size
    described = described if "fx" in described else described | _lens_beside(path, layout)
    focal, poses = ASSUMED_FOCAL * width, identity_poses(count)
    if POSES in layout.required or (path / POSES).exists():
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


def _lens_beside(path: Path, layout: Layout) -> dict[str, float]:
    """The intrinsics in the layout's `lens_file`, as `sequence.json` names them; empty without."""
    if layout.lens_file is None or not (path / layout.lens_file).is_file():
        return {}
    return lens_entries(read_camera_matrix(path / layout.lens_file))


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
        facts |= lens_entries(read_camera_matrix(lens))
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
