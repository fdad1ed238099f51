"""Which depth and which masks a clip gets, by what the user asked for and what there is."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Literal

import numpy as np
from numpy.typing import NDArray

from ..core.checks import InputError
from ..data.depth_files import DEPTH_SUFFIXES, read_depth_file, read_values
from ..data.reading import complaint
from ..footage.changes import COLOR_DISTANCE, color_share
from ..footage.eyes import eye_order, vertical_offset_px
from ..footage.units import guess_unit
from .aligned_depth import Kind, fit_reference, relative_to_mm
from .clip import Clip
from .config import PrepareConfig
from .frame_files import match_files
from .frames import Depth, Developed, Makers, Mask
from .mask_files import SUFFIXES, read_user_mask, tool_polarity
from .shading import fit_shading
from .stereo import stereo_depth
from .survey import Survey
from .tool_mask import fit_tools
from .view import View

FITTED_SAMPLES = 16
"""Samples that tools and light are learned from."""
MAX_ROW_OFFSET_PX = 1.5
"""Rows of the two eyes further apart than this cannot be matched well."""
NETWORK = "depth-anything"
FEWEST_STEPS = 256
"""Depth with no more different values than this was stored in 8 bits."""
DepthKind = Literal["none", "sgbm", "shading", "network", "folder"]
Measure = Callable[[Developed], Depth]
Shade = Callable[[NDArray[np.uint8], Mask], Depth]


@dataclass
class Chosen:
    """How the frames of a clip are made, and what to say about it."""

    makers: Makers
    sources: dict[str, str]
    """Where pictures, depth and masks come from."""
    relative: bool
    """Whether the depth's scale is assumed."""
    remarks: list[str]


def choose_makers(cfg: PrepareConfig, clip: Clip, survey: Survey) -> Chosen:
    """Bind depth and masks to the clip.

    Raises:
        InputError: a folder that an option names cannot be used, or what is asked for needs a second eye.
    """
    view, step = survey.view, max(len(survey.samples) // FITTED_SAMPLES, 1)
    samples = []
    for shot in survey.samples[::step]:
        right = None if shot.right is None else view.picture(shot.right, right=True)
        samples.append(Developed(0, shot.index, view.picture(shot.left), right, None))
    remarks = _look_at_eyes(samples, view, clip) if clip.stereo else []
    kind = _depth_kind(cfg, clip)
    relative = kind in ("shading", "network") or cfg.depth_relative != "no"
    measure, source = (None, kind) if kind in ("none", "shading") else _measured_depth(kind, cfg, clip, survey)
    near = [measure(frame) for frame in samples] if measure and not relative and cfg.masks == "auto" else None
    tools, mask_source, said = _tools(cfg, survey, samples, near)
    shade: Shade | None = None
    if relative:
        pictures, usable = [frame.rgb_u8 for frame in samples], [view.inside & ~tools(frame) for frame in samples]
        if measure is None:
            shade = fit_shading(pictures, usable, cfg.working_distance_mm).depth
        else:
            measure = _scaled(measure, samples, usable, cfg)
        said.append(
            f"depth is relative ({source}), scaled to a median of {cfg.working_distance_mm:g} mm: "
            "its mm, and those of every score, are not mm"
        )
    elif kind == "folder":
        said += _doubts(samples, [measure(frame) for frame in samples], view, cfg.depth)
    wanted = _inside_body([frame.rgb_u8 for frame in samples]) if cfg.drop_out_of_body else lambda rgb_u8: True
    makers = Makers(measure, shade, tools, kind == "sgbm", wanted)
    sources = {"images": f"video, {clip.layout}", "depth": source, "masks": mask_source}
    return Chosen(makers, sources, relative, remarks + said)


def _look_at_eyes(samples: list[Developed], view: View, clip: Clip) -> list[str]:
    """Refuse exchanged eyes; remarks about rows that do not match."""
    middle = [frame for frame in samples if frame.right_u8 is not None][:: max(len(samples) // 3, 1)]
    orders = [eye_order(frame.rgb_u8, frame.right_u8, view.center_shift_px) for frame in middle]
    if sum(order.swapped for order in orders) > len(orders) / 2:
        hint = "Take away --swap-eyes." if clip.swap else "Add --swap-eyes."
        shares = f"{orders[0].exchanged:.0%} of the picture matches exchanged, {orders[0].as_given:.0%} as given"
        raise complaint(clip.source.path, "the left eye first", f"the right one ({shares})", hint)
    offset = float(np.nanmedian([vertical_offset_px(frame.rgb_u8, frame.right_u8) for frame in middle]))
    if offset > MAX_ROW_OFFSET_PX:
        return [f"the eyes' rows are {offset:.1f} px apart, depth will be poor: is it this video's calibration?"]
    return []


def _depth_kind(cfg: PrepareConfig, clip: Clip) -> DepthKind:
    """What --depth asks for.

    Raises:
        InputError: --depth-relative is given with anything but a folder.
    """
    if cfg.depth == "auto":
        kind: DepthKind = "sgbm" if clip.stereo else "shading"
    elif cfg.depth in ("none", "sgbm", "shading"):
        kind = cfg.depth
    else:
        kind = "network" if cfg.depth.partition(":")[0] == NETWORK else "folder"
    if cfg.depth_relative != "no" and kind != "folder":
        raise complaint("--depth-relative", "a folder with --depth", cfg.depth, "Leave it out.")
    return kind


def _measured_depth(kind: DepthKind, cfg: PrepareConfig, clip: Clip, survey: Survey) -> tuple[Measure, str]:
    """What is measured on a frame without a mask (depth in mm, or a network's relative values), and its source."""
    view = survey.view
    if kind == "sgbm":
        if not clip.stereo or view.baseline_mm is None:
            hint = "Give --calibration with both eyes, or --depth shading."
            raise complaint("--depth sgbm", "two eyes and their calibration", "one", hint)
        focal, baseline = float(view.matrix[0, 0]), view.baseline_mm

        def match(frame: Developed) -> Depth:
            assert frame.right_u8 is not None
            pair = frame.rgb_u8, frame.right_u8
            return stereo_depth(*pair, focal, baseline, cfg.stereo, view.center_shift_px).depth

        return match, "stereo: semi-global matching"
    if kind == "network":
        from .depth_network import DEFAULT_MODEL, DepthNetwork

        network = DepthNetwork(cfg.depth.partition(":")[2] or DEFAULT_MODEL)
        return lambda frame: network.inverse_depth(frame.rgb_u8), "Depth Anything V2"
    files = match_files(Path(cfg.depth), DEPTH_SUFFIXES, "depth", survey.indices)
    if cfg.depth_relative == "no" and not cfg.depth_unit_mm:
        hint = "1 for mm, 0.01 for hundredths, 1000 for m; or --depth-relative depth or disparity."
        raise complaint("--depth-unit-mm", f"mm per unit of the files in {cfg.depth}", "none", hint)

    def read(path: Path, size: tuple[int, int]) -> NDArray:
        if cfg.depth_relative != "no":
            return read_values(path, size)
        return read_depth_file(path, cfg.depth_unit_mm, size)

    return lambda frame: view.values(_of_either_size(read, files[frame.index], view)), "user's files"


def _scaled(measure: Measure, samples: list[Developed], usable: list[Mask], cfg: PrepareConfig) -> Measure:
    """Relative values, brought to the working distance by constants of the clip."""
    kind: Kind = "depth" if cfg.depth_relative == "depth" else "disparity"
    reference = fit_reference([measure(frame) for frame in samples], usable, kind, cfg.working_distance_mm)
    return lambda frame: relative_to_mm(measure(frame), kind, reference)


def _doubts(samples: list[Developed], depths: list[Depth], view: View, folder: str) -> list[str]:
    """Refuse depth that no endoscope can have measured; remarks about depth that it hardly can."""
    guess = guess_unit((d, d > 0, f.rgb_u8, view.inside) for f, d in zip(samples, depths, strict=True))
    if guess.unit in ("m", "0.01 mm"):
        hint = f"Is the unit right? The values look like {guess.unit}: multiply it by {guess.mm_per_unit:g}."
        raise complaint("--depth-unit-mm", "tissue 20 to 250 mm away", f"{guess.median:g} mm in {folder}", hint)
    remarks = [] if guess.unit == "mm" else [f"is the depth's unit right? {guess.reason}"]
    if max(len(np.unique(depth)) for depth in depths) <= FEWEST_STEPS:
        remarks.append("the depth has no more than 256 steps: 8-bit files are too coarse for motion in mm")
    return remarks


def _of_either_size(read: Callable[[Path, tuple[int, int]], NDArray], path: Path, view: View) -> NDArray:
    """A file of the size of the source's pictures, or of the frames."""
    try:
        return read(path, view.source_size)
    except InputError:
        if view.size == view.source_size:
            raise
        try:
            return read(path, view.size)
        except InputError:
            pass
        raise


def _tools(
    cfg: PrepareConfig, survey: Survey, samples: list[Developed], depths: Sequence[Depth] | None
) -> tuple[Callable[[Developed], Mask], str, list[str]]:
    """Masks, their source, and remarks."""
    view = survey.view
    if cfg.masks == "none":
        return lambda frame: np.zeros_like(view.inside), "none", []
    if cfg.masks == "auto":
        model = fit_tools([frame.rgb_u8 for frame in samples], [view.inside] * len(samples), depths)
        said = f"tools found by color{' and depth' if depths else ''} in {model.seen_share:.0%} of the samples"
        if not model.seen_share:
            said = "no tools found by color"
        remark = f"{said}; look at masks/ and correct them in any paint program (255 = tool)"
        return lambda frame: model.mask(frame.rgb_u8, view.inside, frame.depth if depths else None), said, [remark]
    files = match_files(Path(cfg.masks), SUFFIXES, "masks", survey.indices)

    def high(frame: Developed) -> Mask:
        return view.values(_of_either_size(read_user_mask, files[frame.index], view))

    polarity = tool_polarity(cfg.mask_tool_value, [high(f) for f in samples], [f.rgb_u8 for f in samples])
    tool_is_high = polarity.tool_is_high
    return lambda frame: high(frame) == tool_is_high, "user's files", [f"masks: {polarity.reason}"]


def _inside_body(pictures: list[NDArray[np.uint8]]) -> Callable[[NDArray[np.uint8]], bool]:
    """Whether a picture has about the color that most of the samples have."""
    usual = np.median([color_share(picture) for picture in pictures], 0)
    return lambda rgb_u8: bool(np.abs(color_share(rgb_u8) - usual).max() < COLOR_DISTANCE)
