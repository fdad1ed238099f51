"""Choose how depth and tool masks of a clip are made, from the options and the available inputs."""

from __future__ import annotations

from collections.abc import Callable
from contextlib import suppress
from dataclasses import dataclass
from pathlib import Path
from typing import Literal, TypeVar

import cv2
import numpy as np
from numpy.typing import NDArray

from ..core.checks import InputError, input_error
from ..core.ranges import spread
from ..data.depth_files import DEPTH_SUFFIXES, read_depth_file, read_stored, read_values
from ..data.depth_fill import is_measured
from ..data.description import TOOLS_FOUND
from ..data.found_tools import FoundTools
from ..data.frame_files import match_files, match_names
from ..data.mask_files import tool_polarity
from ..data.mask_folders import MaskFrame, open_mask_folder
from ..footage.changes import COLOR_DISTANCE, color_share
from ..footage.stereo_order import stereo_order, vertical_offset_px
from ..footage.units import guess_unit
from .config import PrepareConfig
from .first_pass import FirstPass
from .frame_geometry import FrameGeometry
from .frames import Depth, FrameMethods, Mask, MeasuredFrame
from .relative_depth import Kind, fit_reference, relative_to_mm
from .sam2 import is_sam2
from .shading import fit_shading
from .stereo import stereo_depth
from .video_clip import Clip

FITTED_SAMPLES = 16
"""Number of frames to which the tool and shading models are fitted."""
MAX_ROW_OFFSET_PX = 1.5
"""If the rows of the two cameras are further apart, stereo matching is poor."""
NETWORK = "depth-anything"
DepthKind = Literal["none", "sgbm", "shading", "network", "folder"]
Measure = Callable[[MeasuredFrame], Depth]
A = TypeVar("A")
Tools = Callable[[MeasuredFrame], FoundTools]
Shade = Callable[[NDArray[np.uint8], Mask], Depth]


@dataclass
class ChosenMethods:
    """How depth and masks of a clip are made."""

    methods: FrameMethods
    sources: dict[str, str]
    """Where images, depth and masks come from."""
    relative: bool
    """Whether the scale of the depth is assumed."""
    notes: list[str]
    """Notes for the user, one line each."""
    finds_tools: bool = False
    """Whether our own finder makes the masks, so that each frame has a confidence."""


def choose_methods(cfg: PrepareConfig, clip: Clip, first_pass: FirstPass) -> ChosenMethods:
    """Choose the methods and fit their models to samples of the clip.

    Raises:
        InputError: a folder named by an option cannot be used, or an option needs a second camera.
    """
    geometry, step = first_pass.geometry, max(len(first_pass.samples) // FITTED_SAMPLES, 1)
    samples = []
    for frame in first_pass.samples[::step]:
        right = None if frame.right is None else geometry.image(frame.right, right=True)
        samples.append(MeasuredFrame(0, frame.index, geometry.image(frame.left), right, None))
    notes = _check_stereo(samples, geometry, clip) if clip.stereo else []
    kind = _depth_kind(cfg, clip)
    relative = kind in ("shading", "network") or cfg.depth_relative != "no"
    measure, source = None, kind
    if kind not in ("none", "shading"):
        measure, source, depth_notes = _measured_depth(kind, cfg, clip, first_pass)
        notes += depth_notes
    tools, mask_source, mask_note = _tools(cfg, first_pass, samples)
    notes += mask_note
    shade: Shade | None = None
    if relative:
        images, usable = (
            [frame.rgb_u8 for frame in samples],
            [geometry.inside & ~tools(frame).mask for frame in samples],
        )
        if measure is None:
            shade = fit_shading(images, usable, cfg.working_distance_mm).depth
        else:
            measure = _scaled(measure, samples, usable, cfg)
        notes.append(
            f"depth is relative ({source}), with its median set to {cfg.working_distance_mm:g}: lengths have no unit "
            "(rel.). For mm use a stereo video or measured depth."
        )
    elif kind == "folder":
        notes += _check_unit(samples, [measure(frame) for frame in samples], geometry, cfg.depth)
    wanted = _inside_body([frame.rgb_u8 for frame in samples]) if cfg.drop_out_of_body else lambda rgb_u8: True
    methods = FrameMethods(measure, shade, tools, kind == "sgbm", wanted)
    sources = {"images": f"video, {clip.layout}", "depth": source, "masks": mask_source}
    return ChosenMethods(methods, sources, relative, notes, finds_tools=cfg.masks == "auto")


def _check_stereo(samples: list[MeasuredFrame], geometry: FrameGeometry, clip: Clip) -> list[str]:
    """Reject swapped cameras; return a note if the rows do not match."""
    middle = [frame for frame in samples if frame.right_u8 is not None][:: max(len(samples) // 3, 1)]
    orders = [stereo_order(frame.rgb_u8, frame.right_u8) for frame in middle]
    if sum(order.swapped for order in orders) > len(orders) / 2:
        fix = "Remove --swap-eyes." if clip.swap else "Add --swap-eyes."
        shares = f"{orders[0].exchanged:.0%} of the image matches swapped, {orders[0].as_given:.0%} as given"
        raise input_error(clip.source.path, "the left camera first", f"the right one ({shares})", fix)
    offsets = np.array([vertical_offset_px(frame.rgb_u8, frame.right_u8) for frame in middle])
    offset = float(np.median(offsets[np.isfinite(offsets)])) if np.isfinite(offsets).any() else 0.0
    if offset > MAX_ROW_OFFSET_PX:
        return [
            f"the rows of the cameras are {offset:.1f} px apart; depth will be poor. Pass the calibration of "
            "this video, or --row-offset auto."
        ]
    return []


def _depth_kind(cfg: PrepareConfig, clip: Clip) -> DepthKind:
    """The depth method that --depth selects.

    Raises:
        InputError: --depth-relative without a depth folder.
    """
    if cfg.depth == "auto":
        kind: DepthKind = "sgbm" if clip.stereo else "shading"
    elif cfg.depth in ("none", "sgbm", "shading"):
        kind = cfg.depth
    else:
        kind = "network" if cfg.depth.partition(":")[0] == NETWORK else "folder"
    if cfg.depth_relative != "no" and kind != "folder":
        raise input_error("--depth-relative", "a folder with --depth", cfg.depth, "Remove --depth-relative.")
    return kind


def _measured_depth(
    kind: DepthKind, cfg: PrepareConfig, clip: Clip, first_pass: FirstPass
) -> tuple[Measure, str, list[str]]:
    """A function that measures depth without a mask (mm, or relative values of a network), its name, and notes."""
    geometry = first_pass.geometry
    if kind == "sgbm":
        if not clip.stereo or geometry.baseline_mm is None:
            fix = "`--calibration FILE` with both cameras, or `--depth shading`."
            raise input_error("--depth sgbm", "two cameras and their calibration", "one camera", fix)
        focal, baseline = float(geometry.matrix[0, 0]), geometry.baseline_mm

        def match(frame: MeasuredFrame) -> Depth:
            assert frame.right_u8 is not None
            return stereo_depth(frame.rgb_u8, frame.right_u8, focal, baseline, cfg.stereo).depth

        return match, "stereo: semi-global matching", []
    if kind == "network":
        from .depth_network import DEFAULT_MODEL, DepthNetwork

        network = DepthNetwork(cfg.depth.partition(":")[2] or DEFAULT_MODEL)
        return lambda frame: network.inverse_depth(frame.rgb_u8), "Depth Anything V2", []
    files, notes = match_files(Path(cfg.depth), DEPTH_SUFFIXES, "depth", first_pass.indices, first_pass.image_names)
    if cfg.depth_relative == "no" and not cfg.depth_unit_mm:
        fix = "`--depth-unit-mm 1` for mm, `0.01` for 0.01 mm, `1000` for m; or `--depth-relative depth`."
        raise input_error("--depth-unit-mm", f"mm per unit of the files in {cfg.depth}", "none", fix)

    if cfg.depth_relative == "no":
        some = spread(len(first_pass.indices), FITTED_SAMPLES)
        notes += _check_stored([read_stored(files[first_pass.indices[i]]) for i in some])

    def read(path: Path, size: tuple[int, int]) -> NDArray:
        if cfg.depth_relative != "no":
            if cfg.depth_relative == "depth":
                return read_depth_file(path, 1.0, size, relative=True)
            return read_values(path, size)
        return read_depth_file(path, cfg.depth_unit_mm, size)

    return lambda frame: _values(read, files[frame.index], first_pass), "user's files", notes


def _scaled(measure: Measure, samples: list[MeasuredFrame], usable: list[Mask], cfg: PrepareConfig) -> Measure:
    """Relative values scaled to the working distance by constants of the clip."""
    kind: Kind = "depth" if cfg.depth_relative == "depth" else "disparity"
    reference = fit_reference([measure(frame) for frame in samples], usable, kind, cfg.working_distance_mm)
    return lambda frame: relative_to_mm(measure(frame), kind, reference)


def _check_unit(samples: list[MeasuredFrame], depths: list[Depth], geometry: FrameGeometry, folder: str) -> list[str]:
    """Reject depth outside the range of an endoscope; return notes on implausible depth."""
    guess = guess_unit((d, d > 0, f.rgb_u8, geometry.inside) for f, d in zip(samples, depths, strict=True))
    if guess.unit in ("m", "0.01 mm"):
        fix = f"The values look like {guess.unit}: multiply --depth-unit-mm by {guess.mm_per_unit:g}."
        raise input_error("--depth-unit-mm", "tissue 20 to 250 mm away", f"{guess.median:g} mm in {folder}", fix)
    return [] if guess.unit == "mm" else [f"the depth unit may be wrong: {guess.reason}. Check --depth-unit-mm."]


def _check_stored(images: list[NDArray]) -> list[str]:
    """Notes on the numbers (H, W) of some depth files: 8 bits, and what stands for missing depth."""
    notes = []
    if all(image.dtype == np.uint8 for image in images):
        notes.append("the depth has at most 256 steps: 8-bit files are too coarse for motion in mm. Use 16-bit files.")
    filled = [np.isfinite(image) & (image > 0) & ~is_measured(image) for image in images]
    if any(each.any() for each in filled):
        least = min(float(image[each].min()) for image, each in zip(images, filled, strict=True) if each.any())
        share = float(np.mean([each.mean() for each in filled]))
        notes.append(f"depth: numbers from {least:g} on are far above the rest and count as missing, {share:.1%} of it")
    return notes


def _values(read: Callable[[A, tuple[int, int]], NDArray], path: A, first_pass: FirstPass) -> NDArray:
    """The frame (H, W) of a file that has the size of the source images, of the frames, or of the stored pixels."""
    geometry, stored = first_pass.geometry, first_pass.stored_size
    try:
        return geometry.values(read(path, geometry.source_size))
    except InputError:
        with suppress(InputError):
            return geometry.values(read(path, geometry.size))
        if stored is not None:
            with suppress(InputError):
                values = read(path, stored)
                kind = np.uint8 if values.dtype == bool else values.dtype
                square = cv2.resize(values.astype(kind), geometry.source_size, interpolation=cv2.INTER_NEAREST_EXACT)
                return geometry.values(square.astype(values.dtype))
        raise


def _tools(cfg: PrepareConfig, first_pass: FirstPass, samples: list[MeasuredFrame]) -> tuple[Tools, str, list[str]]:
    """A function that returns the tools of a frame, the name of its source, and a note."""
    geometry = first_pass.geometry
    if cfg.mask_labels and (cfg.masks in ("auto", "none") or is_sam2(cfg.masks)):
        raise input_error("--mask-labels", "a folder with --masks", cfg.masks, "Remove --mask-labels.")
    if cfg.masks == "none":
        return lambda frame: FoundTools(np.zeros_like(geometry.inside), 1.0), "none", []
    if cfg.masks == "auto" or is_sam2(cfg.masks):
        from ..tool_masks import ToolFinder  # imports torch

        finder = ToolFinder()
        found = [finder.find(sample.rgb_u8, geometry.inside) for sample in samples]
        share = sum(bool(tools.mask.any()) for tools in found) / max(len(found), 1)
        source = f"{TOOLS_FOUND} in {share:.0%} of the samples" if share else f"no {TOOLS_FOUND}"
        hint = "Check masks/, and correct them in `endoprior view` or any paint program (255 = tool)."
        if not share:
            hint = "Tools in view become tissue: paint them in masks/ (255 = tool), or pass --masks FOLDER."
        notes = [] if is_sam2(cfg.masks) else [f"masks: {source}. {hint}"]  # its own masks replace these
        return lambda frame: finder.find(frame.rgb_u8, geometry.inside), source, notes
    return _user_masks(cfg, first_pass, samples)


def _user_masks(
    cfg: PrepareConfig, first_pass: FirstPass, samples: list[MeasuredFrame]
) -> tuple[Tools, str, list[str]]:
    """As `_tools`, from the user's files."""
    path = Path(cfg.masks)
    given = open_mask_folder(path, cfg.mask_labels)
    names = [each.name for each in given.frames]
    matched = match_names(path, names, first_pass.indices, first_pass.image_names, in_order_only=given.in_order_only)

    def read(each: MaskFrame, size: tuple[int, int]) -> Mask:
        return each.read(size)

    def high(frame: MeasuredFrame) -> Mask:
        return _values(read, given.frames[matched.files[frame.index]], first_pass)

    notes = [f"masks: {each}" for each in (given.note, matched.rule) if each]
    if given.tool_is_high is None or cfg.mask_tool_value != "auto":
        polarity = tool_polarity(cfg.mask_tool_value, [high(f) for f in samples], [f.rgb_u8 for f in samples])
        tool_is_high = polarity.tool_is_high
        notes.append(f"masks: {polarity.reason}")
    else:
        tool_is_high = given.tool_is_high
    return lambda frame: FoundTools(high(frame) == tool_is_high, 1.0), "user's files", notes


def _inside_body(images: list[NDArray[np.uint8]]) -> Callable[[NDArray[np.uint8]], bool]:
    """A function that tells whether an image has the usual color of the samples."""
    usual = np.median([color_share(image) for image in images], 0)
    return lambda rgb_u8: bool(np.abs(color_share(rgb_u8) - usual).max() < COLOR_DISTANCE)
