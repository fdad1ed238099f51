"""Images with a lens and a pose each, as reconstruction programs leave them: the sequence that they make."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from ..core.checks import input_error
from ..core.config import DataConfig
from ..core.shell import command
from ..core.types import Camera
from .assemble import Pixels, assemble, kept_frames
from .files import list_files
from .frame_files import Kind, files_of_images
from .images import DEPTH_SUFFIXES, read_color, read_depth_file, read_tool_mask
from .lens import Lens, Undistorter
from .poses import demand_rotations
from .sequence import FrameSequence

ROUNDED_PX = 1.0
"""Scaled images may differ from the exact shape by rounding."""


@dataclass(frozen=True)
class PosedImage:
    """One image and what is known of it."""

    file: Path
    lens: Lens
    world_to_camera: NDArray[np.float64]
    """(4, 4), OpenCV axes."""
    mask: Path | None = None
    """0 = not to be used, as reconstruction programs have it."""
    depth: Path | None = None


def load_posed(
    path: Path,
    cfg: DataConfig,
    source: Path,
    posed: Sequence[PosedImage],
    files: Sequence[Path],
    remarks: list[str],
    mm_per_unit: float | None = None,
) -> FrameSequence:
    """The sequence of some images, in this order; frames are undistorted.

    Args:
        source: the file of the poses, for messages.
        posed: at least one.
        files: that describe them; the first one holds the lens.
        remarks: what is unusual, so far.
        mm_per_unit: of positions; None if their scale is unknown, and depth is then in their units. Else it is in mm.
    """
    demand_rotations(
        source, np.stack([each.world_to_camera[:3, :3] for each in posed]), "the poses", "export them again."
    )
    height, width = read_color(posed[0].file).shape[:2]
    size = (width, height)
    own = {id(each.lens): each.lens for each in posed}  # images share lenses
    lenses = {key: Undistorter(_fitted(source, lens, size, remarks)) for key, lens in own.items()}
    if any(each.lens.is_bent for each in lenses.values()):
        remarks.append(f"{source}: the lens is distorted; frames are undistorted, without part of the periphery")
    masks, tool_value = _masks(path, posed, remarks)
    depths = _depths(path, files[0], source, posed, remarks)
    if mm_per_unit is None:
        remarks.append(f"{source}: the scale of its poses is unknown; lengths are not millimeters")
    kept = kept_frames(len(posed), cfg, having=[files for files in (masks, depths) if files])
    images = [posed[i].file for i in kept]
    scale = mm_per_unit or 1.0
    unit = cfg.depth_unit_mm or 1.0

    def decode(index: int) -> Pixels:
        at = kept[index]
        undistorter = lenses[id(posed[at].lens)]
        tissue = undistorter.shown
        if mask := masks.get(at):
            tool = read_tool_mask(mask, tool_value, size)
            tissue = tissue & (undistorter.nearest((~tool).astype(np.uint8)) > 0)
        depth = read_depth_file(depths[at], unit, size) if depths else np.zeros((height, width), np.float32)
        return undistorter.smooth(read_color(images[index], size)), tissue, undistorter.nearest(depth)

    def camera(at: int) -> Camera:
        matrix, pose = lenses[id(posed[at].lens)].lens.matrix, posed[at].world_to_camera.copy()
        pose[:3, 3] *= scale
        return Camera(width, height, matrix[0, 0], matrix[1, 1], matrix[0, 2], matrix[1, 2], pose)

    others = [column[at] for column in (masks, depths) if column for at in kept]
    return assemble(
        path,
        cfg,
        [camera(at) for at in kept],
        decode,
        images=images,
        files=[*(file for file in others if file is not None), *files],
        remarks=remarks,
        mask_folder="masks" if tool_value == 255 else ".",
        depth_is_relative=mm_per_unit is None,
        sources={"poses": f"given, {source.name}"},
    )


def _fitted(source: Path, lens: Lens, size: tuple[int, int], remarks: list[str]) -> Lens:
    """The lens in px of images of that size."""
    if (lens.width, lens.height) == size:
        return lens
    scale, shape = size[0] / lens.width, f"{lens.width}x{lens.height} px"
    if abs(scale * lens.height - size[1]) > ROUNDED_PX:
        fix = "pass the images that it was made of."
        raise input_error(source, f"images of {shape}, or of that shape", f"{size[0]}x{size[1]}", fix)
    focal = lens.matrix[0, 0]
    remarks.append(
        f"{source}: its lens is that of {shape}; fx {focal:g} px is scaled to {focal * scale:g} px for "
        f"{size[0]}x{size[1]}"
    )
    return lens.scaled(*size)


def _masks(path: Path, posed: Sequence[PosedImage], remarks: list[str]) -> tuple[Mapping[int, Path | None], int]:
    """The mask of each image, None where all of it is tissue, and the value of tools; nothing without any masks."""
    named = {i: each.mask for i, each in enumerate(posed)}
    if any(named.values()):
        if without := list(named.values()).count(None):
            remarks.append(f"{path}: {without} of {len(named)} images name no mask, all of them counts as tissue")
        return named, 0
    folder = path / "masks"
    if not folder.is_dir():
        remarks.append(f"{folder}: missing, every pixel counts as tissue")
        return {}, 255
    # COLMAP's own masks are called like the image, with .png behind its suffix, and 0 is not used.
    if all((folder / f"{each.file.name}.png").is_file() for each in posed):
        return {i: folder / f"{each.file.name}.png" for i, each in enumerate(posed)}, 0
    return _beside(folder, posed, "masks", (".png",), remarks), 255


def _depths(
    path: Path, calibration: Path, poses: Path, posed: Sequence[PosedImage], remarks: list[str]
) -> dict[int, Path]:
    """The depth of each image that has one."""
    named = {i: each.depth for i, each in enumerate(posed) if each.depth is not None}
    if named:
        if without := len(posed) - len(named):
            remarks.append(f"{path}: {without} of {len(posed)} images name no depth and are left out")
        return named
    if (path / "depth").is_dir():
        remarks.append(f"{path / 'depth'}: taken to be in the units of the poses")
        return _beside(path / "depth", posed, "depth", DEPTH_SUFFIXES, remarks)
    prepare = command("prepare", posed[0].file.parent, "OUT", "--calibration", calibration, "--poses", poses)
    remarks.append(f"{path / 'depth'}: missing; `{prepare}` makes depth")
    return {}


def _beside(
    folder: Path, posed: Sequence[PosedImage], kind: Kind, suffixes: tuple[str, ...], remarks: list[str]
) -> dict[int, Path]:
    """The file of each image in a folder."""
    files = list_files(folder, suffixes, "nerfstudio")
    return files_of_images(folder, files, kind, [each.file for each in posed], remarks)
