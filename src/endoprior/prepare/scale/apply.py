"""Bring what `prepare` is about to complete, or a sequence folder, to mm."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path

import numpy as np

from ...core.checks import input_error
from ...data import load_sequence
from ...data.description import PATH_RECORD, read_description
from ...data.images import read_depth
from ...data.scale import Scale, demand_relative, described_scale
from ...data.scale_files import finish_scale, scaled_record, write_scale
from ...data.writer import FrameFiles, demand_writable
from ..camera_path.tracks import CameraPath, PoseInput
from ..folder_path import of_all_images
from .find import SHAFT_OPTION, Frame, check_scale_options, find_scale


def demand_no_unit(known_length: Sequence[str], shaft_mm: float, relative: bool) -> None:
    """Raise InputError if a scale is given for depth that is in mm already."""
    if (known_length or shaft_mm) and not relative:
        option = "--known-length" if known_length else SHAFT_OPTION
        raise input_error(option, "relative depth, of a video with one eye", "depth in mm", f"remove {option}.")


def use_scale(
    files: FrameFiles, frame: Frame, path: CameraPath | None, known_length: Sequence[str], shaft_mm: float
) -> tuple[CameraPath | None, list[str]]:
    """Find the scale of written frames, and put it into their description; the path in mm, and notes.

    Depth files stay: the factor goes into `depth_scale`, so that an interrupted `prepare` cannot apply it twice.
    """
    if not (known_length or shaft_mm):
        return path, []
    meta = files.meta
    scale = find_scale(frame, files.count, meta.matrix, known_length, shaft_mm)
    files.meta = replace(meta, depth_scale=meta.depth_scale * scale.factor, depth_relative=False, scale=scale)
    if path is not None:
        moved = path.camera_to_world.copy()
        moved[:, :3, 3] *= scale.factor
        files.write_json(PATH_RECORD, scaled_record(path.record(), scale.factor))
        path = replace(path, camera_to_world=moved)
    return path, [f"scale: {scale.text}. 1 rel. in other notes is {scale.factor:.3g} mm"]


def scale_folder(folder: Path, known_length: Sequence[str], shaft_mm: float) -> Scale:
    """Find the scale of a sequence folder, and write it there in place of any other.

    Args:
        known_length, shaft_mm: as for `find_scale`.
    Raises:
        InputError: no sequence folder with relative depth, read-only, or an option that cannot be used; then nothing
            is changed.
    """
    check_scale_options(known_length, shaft_mm)
    if folder.is_dir():
        demand_writable(folder)
        finish_scale(folder)
    description = folder / "sequence.json"
    sequence, described = load_sequence(folder), read_description(description)
    demand_relative(folder, described)
    if not sequence.mask_files or sequence.reading is None:
        raise input_error(folder, "images, masks and depth in a sequence folder", "another layout", "prepare it.")
    old = described_scale(description, described)
    # Relative units, as if no scale had been applied.
    unit = float(described.get("depth_scale", 1.0)) / (old.factor if old else 1.0)
    depths, first = of_all_images(folder / "depth", sequence.image_names), sequence.camera(0)
    size = (first.width, first.height)

    def frame(index: int) -> PoseInput:
        seen = sequence.frame(index)
        return PoseInput(seen.rgb_u8, seen.tissue_mask, read_depth(depths[index], unit, size))

    matrix = np.array([[first.fx, 0, first.cx], [0, first.fy, first.cy], [0, 0, 1]])
    scale = find_scale(frame, len(sequence), matrix, known_length, shaft_mm)
    write_scale(folder, scale)
    return scale
