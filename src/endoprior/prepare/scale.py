"""Find the scale of frames with relative depth, as `--known-length` and `--shaft-mm` say, and bring them to mm: what
`prepare` is about to complete, or a sequence folder.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from ..core.checks import input_error
from ..core.ranges import evenly_spaced
from ..data import load_sequence
from ..data.description import PATH_RECORD, read_description
from ..data.edit import demand_writable, finish_scale, scaled_record, write_scale
from ..data.images import read_depth
from ..data.scale import (
    Scale,
    demand_plausible,
    demand_relative,
    described_scale,
    parse_known_length,
    scale_by_lengths,
)
from ..data.writer import FrameFiles
from ..footage.border import find_outline, masked_border
from .camera_path.path import CameraPath
from .camera_path.tracks import FrameReader
from .folder_path import of_all_images
from .shaft import frontier, tip_readings

SHAFT_OPTION = "--shaft-mm"
SAMPLES = 16  # number of frames in which the border of the view is looked for
MIN_MM, MAX_MM = 1.0, 20.0
"""Range of diameters of shafts."""
KNOW_OTHERWISE = "give a length that you know: `--known-length FRAME,X1,Y1,X2,Y2,MM`."


def check_scale_options(known_length: Sequence[str], shaft_mm: float) -> None:
    """Raise InputError for values of the options that cannot be, or both of them."""
    for text in known_length:
        parse_known_length(text)
    if shaft_mm and not MIN_MM <= shaft_mm <= MAX_MM:
        fix = f"`{SHAFT_OPTION} 8` for most robotic instruments, `{SHAFT_OPTION} 5` for most others."
        raise input_error(SHAFT_OPTION, f"a diameter of {MIN_MM:g} to {MAX_MM:g} mm", f"{shaft_mm:g}", fix)
    if known_length and shaft_mm:
        fix = f"remove {SHAFT_OPTION}: a known length is the surer one."
        raise input_error("--known-length", f"no {SHAFT_OPTION}", f"{SHAFT_OPTION} {shaft_mm:g}", fix)


def find_scale(frames: FrameReader, matrix: NDArray[np.float64], known_length: Sequence[str], shaft_mm: float) -> Scale:
    """The scale that one of the options gives.

    Args:
        frames: with relative depth.
        matrix: (3, 3) K, px, with the left-most pixel centered at 0.5.
        known_length: texts `FRAME,X1,Y1,X2,Y2,MM`.
        shaft_mm: diameter of the shafts, mm; 0: not given.
    Raises:
        InputError: what an option names is not there.
    """
    check_scale_options(known_length, shaft_mm)
    if known_length:

        def read(index: int) -> tuple[NDArray[np.float32], NDArray[np.bool_]]:
            return frames.depth(index), ~frames.tissue(index)

        return scale_by_lengths([parse_known_length(text) for text in known_length], read, frames.count, matrix)
    return scale_by_shafts(frames, matrix, shaft_mm)


def scale_by_shafts(frames: FrameReader, matrix: NDArray[np.float64], shaft_mm: float) -> Scale:
    """The scale at which the tips of instruments touch tissue where they do, of shafts with this diameter, mm.

    Raises:
        InputError: no tool in the masks, or no shaft that is straight and long enough.
    """
    count, samples = frames.count, evenly_spaced(frames.count, SAMPLES)
    images = [frames.color(i) for i in samples]
    outside = masked_border(find_outline(images), images, map(frames.tissue, samples))
    readings, with_tools = [], 0
    for i in range(count):
        seen = frames.frame(i)
        tools = ~seen.tissue_mask & ~outside
        with_tools += bool(tools.any())
        readings += tip_readings(i, tools, outside, seen.rgb_u8, seen.depth, matrix, shaft_mm / 2)
    if not with_tools:
        raise input_error(SHAFT_OPTION, "tools in the masks", f"none in {count} frames", KNOW_OTHERWISE)
    if not readings:
        want, got = "frames with a straight shaft from the border to a tip on tissue", f"none of {count}"
        raise input_error(SHAFT_OPTION, want, got, KNOW_OTHERWISE)
    log_scale, error = frontier(readings, images[0].shape[1])
    factor = float(np.exp(log_scale))
    demand_plausible(SHAFT_OPTION, factor)
    seen_in = len({reading.frame for reading in readings})
    return Scale(factor, error, f"shaft of {shaft_mm:g} mm in {seen_in} frame{'s' if seen_in > 1 else ''}")


def demand_no_unit(known_length: Sequence[str], shaft_mm: float, relative: bool) -> None:
    """Raise InputError if a scale is given for depth that is in mm already."""
    if (known_length or shaft_mm) and not relative:
        option = "--known-length" if known_length else SHAFT_OPTION
        raise input_error(option, "relative depth, of a video of one camera", "depth in mm", f"remove {option}.")


def use_scale(
    files: FrameFiles, frames: FrameReader, path: CameraPath | None, known_length: Sequence[str], shaft_mm: float
) -> tuple[CameraPath | None, list[str]]:
    """Find the scale of written frames, and put it into their description; the path in mm, and notes.

    Depth files stay: the factor goes into `depth_scale`, so that an interrupted `prepare` cannot apply it twice.
    """
    if not (known_length or shaft_mm):
        return path, []
    meta = files.meta
    scale = find_scale(frames, meta.matrix, known_length, shaft_mm)
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

    frames = FrameReader(
        lambda i: sequence.frame(i).rgb_u8,
        lambda i: sequence.frame(i).tissue_mask,
        lambda i: read_depth(depths[i], unit, size),
        len(sequence),
    )
    matrix = np.array([[first.fx, 0, first.cx], [0, first.fy, first.cy], [0, 0, 1]])
    scale = find_scale(frames, matrix, known_length, shaft_mm)
    write_scale(folder, scale)
    return scale
