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
from .files import in_order, list_files
from .frame_files import files_of_images
from .images import DEPTH_SUFFIXES, read_color, read_depth_file, read_tool_mask
from .lens import Lens, Undistorter
from .poses import scale_of
from .sequence import FrameSequence

MM_PER_M = 1000.0


@dataclass(frozen=True)
class PosedImage:
    """One image and what is known of it."""

    file: Path
    lens: Lens
    world_to_camera: NDArray[np.float64]  # (4, 4), OpenCV axes
    tissue_mask_file: Path | None = None  # 0 = not to be used, as reconstruction programs have it
    depth: Path | None = None  # in mm; positions are in m then
    time: float | None = None


def load_posed(
    path: Path, cfg: DataConfig, source: Path, posed: list[PosedImage], files: Sequence[Path], remarks: list[str]
) -> FrameSequence:
    """The sequence of those images that are there, by their times if all have one, else in the order of their names.

    Frames are undistorted. The scale of positions is unknown unless images name their depth, and depth in a folder is
    in their units.

    Args:
        source: the file of the poses, for messages.
        files: that describe the images; the first one holds the lens.
        remarks: what is unusual, so far.
    """
    posed = _sorted(_present(source, posed, remarks))
    height, width = read_color(posed[0].file).shape[:2]
    size = (width, height)
    lenses: dict[int, Undistorter] = {}
    for lens in {id(each.lens): each.lens for each in posed}.values():  # images share lenses
        focal, fix = float(lens.matrix[0, 0]), "pass the images that it was made of."
        scale_of(source, (lens.width, lens.height), size, focal, fix, remarks)
        lenses[id(lens)] = Undistorter(lens.scaled(*size))
    if any(each.lens.is_bent for each in lenses.values()):
        remarks.append(f"{source}: the lens is distorted; frames are undistorted, without part of the periphery")
    masks, tool_value = _masks(path, posed, remarks)
    depths, scale = _depths(path, files[0], source, posed, remarks)
    kept = kept_frames(len(posed), cfg, having=[files for files in (masks, depths) if files])
    posed = [posed[i] for i in kept]

    def decode(index: int) -> Pixels:
        image, at = posed[index], kept[index]
        undistorter = lenses[id(image.lens)]
        tissue = undistorter.shown
        if mask := masks.get(at):
            tool = read_tool_mask(mask, tool_value, size)
            tissue = tissue & (undistorter.nearest((~tool).astype(np.uint8)) > 0)
        depth = np.zeros((height, width), np.float32)
        if depths:
            depth = read_depth_file(depths[at], cfg.depth_unit_mm or 1.0, size)
        return undistorter.smooth(read_color(image.file, size)), tissue, undistorter.nearest(depth)

    def camera(image: PosedImage) -> Camera:
        matrix, pose = lenses[id(image.lens)].lens.matrix, image.world_to_camera.copy()
        pose[:3, 3] *= scale or 1.0
        return Camera(width, height, matrix[0, 0], matrix[1, 1], matrix[0, 2], matrix[1, 2], pose)

    others = [column[at] for column in (masks, depths) if column for at in kept]
    return assemble(
        path,
        cfg,
        [camera(image) for image in posed],
        decode,
        images=[image.file for image in posed],
        files=[*(file for file in others if file is not None), *files],
        remarks=remarks,
        mask_folder="masks" if tool_value == 255 else ".",
        depth_is_relative=scale is None,
        sources={"poses": f"given, {source.name}"},
    )


def _present(source: Path, posed: list[PosedImage], remarks: list[str]) -> list[PosedImage]:
    there = [each for each in posed if each.file.is_file()]
    if not there:
        got = f"none of {len(posed)}, such as {posed[0].file}" if posed else "none"
        raise input_error(source, "images that are there", got, "put the images where the file says.")
    if len(there) < len(posed):
        remarks.append(f"{source}: {len(posed) - len(there)} of {len(posed)} images are not there and are left out")
    return there


def _sorted(posed: list[PosedImage]) -> list[PosedImage]:
    times = [each.time for each in posed if each.time is not None]
    if len({*times}) == len(posed):
        return sorted(posed, key=lambda each: each.time or 0)
    rank = {file: i for i, file in enumerate(in_order(each.file for each in posed))}
    return sorted(posed, key=lambda each: rank[each.file])


def _masks(path: Path, posed: Sequence[PosedImage], remarks: list[str]) -> tuple[Mapping[int, Path | None], int]:
    """The mask of each image, None where all of it is tissue, and the value of tools; nothing without any masks."""
    named = {i: each.tissue_mask_file for i, each in enumerate(posed)}
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
    files, images = list_files(folder, (".png",), "nerfstudio"), [each.file for each in posed]
    return files_of_images(folder, files, "masks", images, remarks), 255


def _depths(
    path: Path, calibration: Path, poses: Path, posed: Sequence[PosedImage], remarks: list[str]
) -> tuple[dict[int, Path], float | None]:
    """The depth of each image that has one, and mm per unit of the positions, None where that is unknown."""
    if named := {i: each.depth for i, each in enumerate(posed) if each.depth is not None}:
        remarks.append(f"{poses}: depth in mm and poses in m, as nerfstudio has them")
        if without := len(posed) - len(named):
            remarks.append(f"{path}: {without} of {len(posed)} images name no depth and are left out")
        return named, MM_PER_M
    found: dict[int, Path] = {}
    if (path / "depth").is_dir():
        remarks.append(f"{path / 'depth'}: taken to be in the units of the poses")
        files, images = list_files(path / "depth", DEPTH_SUFFIXES, "nerfstudio"), [each.file for each in posed]
        found = files_of_images(path / "depth", files, "depth", images, remarks)
    else:
        prepare = command("prepare", posed[0].file.parent, "OUT", "--calibration", calibration, "--poses", poses)
        remarks.append(f"{path / 'depth'}: missing; `{prepare}` makes depth")
    remarks.append(f"{poses}: the scale of its poses is unknown; lengths are not millimeters")
    return found, None
