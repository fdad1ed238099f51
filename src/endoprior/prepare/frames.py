"""Second pass over a clip: choose how depth and masks are made, rectify and measure each frame, write the files.

Tools are found in the frames, read from the user's files, or followed by a video segmenter.
"""

from __future__ import annotations

from collections import deque
from collections.abc import Callable, Iterable, Iterator, Sequence
from dataclasses import asdict, dataclass, replace
from itertools import chain, islice, repeat
from pathlib import Path
from typing import TYPE_CHECKING, Literal

import numpy as np
from numpy.typing import NDArray

from ..core.checks import input_error
from ..core.config import DataConfig
from ..core.ranges import evenly_spaced
from ..data import load_sequence
from ..data.found_tools import FrameRow, found_source, write_rows
from ..data.frame_files import match_files
from ..data.images import (
    DEPTH_SUFFIXES,
    read_color,
    read_depth_file,
    read_stored,
    read_values,
    save_png,
    write_tool_mask,
)
from ..data.pixels import is_measured
from ..data.writer import FrameFiles
from ..footage.changes import COLOR_DISTANCE, color_share
from ..footage.depth_unit import guess_unit
from ..footage.stereo_matching import stereo_order, vertical_offset_px
from ..system.console import ToDo
from ..system.parallel import Pool, frame_threads
from .config import NETWORK, PrepareConfig
from .first_pass import Depth, FirstPass, Image, Mask, MeasuredFrame
from .frame_geometry import FrameGeometry
from .frame_tools import BYTES_PER_PIXEL, HINT, Tools, choose_tools
from .relative_depth import RelativeScale, fit_shading
from .stereo import stereo_depth, temporal_median
from .video_clip import Clip, StereoFrame

if TYPE_CHECKING:
    from ..tool_masks.tool_finder import Progress
    from ..tool_masks.video_segmenter import VideoSegmenter

REACH = 2  # number of frames on each side in the temporal depth filter
FITTED_SAMPLES = 16  # number of frames to which the tool and shading models are fitted
MAX_ROW_OFFSET_PX = 1.5  # if the rows of the two cameras are further apart, stereo matching is poor
DepthKind = Literal["none", "sgbm", "shading", "network", "folder"]
Measure = Callable[[MeasuredFrame], Depth]
WORK = "carried"  # folder of the segmenter's masks, and of small depth maps, until the sequence is complete


@dataclass(frozen=True)
class FrameMethods:
    """How depth and masks of one clip are made."""

    measure: Measure | None  # depth that needs no mask: stereo, files, a network
    shade: Callable[[Image, Mask], Depth] | None  # depth from the shading of an image inside a mask
    tools: Tools
    hidden: Callable[[int, Image], Mask]  # where a frame shows nothing of the body: see `FirstPass.hidden`
    filter_in_time: bool  # whether to filter depth over neighboring frames
    wanted: Callable[[Image], bool]  # whether an image (H, W, 3) belongs in the sequence
    sources: dict[str, str]  # where images, depth and masks come from
    relative: bool  # whether the scale of the depth is assumed
    notes: list[str]  # notes for the user, one line each


def choose_methods(
    cfg: PrepareConfig, clip: Clip, first_pass: FirstPass, folder: Path, progress: Progress
) -> FrameMethods:
    """Choose the methods, fit their models to samples of the clip, and find the tools of all frames.

    Args:
        folder: keeps what was found, for a run that resumes.
    Raises:
        InputError: a folder named by an option cannot be used, or an option needs a second camera.
    """
    geometry, step = first_pass.geometry, max(len(first_pass.samples) // FITTED_SAMPLES, 1)
    samples = [MeasuredFrame.of(frame, geometry) for frame in first_pass.samples[::step]]
    notes = _check_stereo(samples, clip) if clip.stereo else []
    kind = _depth_kind(cfg, clip)
    relative = kind in ("shading", "network") or cfg.depth_relative != "no"
    if cfg.demands_motion and not relative:
        want = "relative depth after `motion:`, such as motion:shading"
        raise input_error("--depth", want, cfg.depth, "Use `--depth motion`.")
    measure, source, depth_notes = _measured_depth(kind, cfg, first_pass)
    every = _counted(first_pass.all_frames(clip), geometry, len(first_pass.indices), progress)
    tools, mask_source, mask_notes = choose_tools(cfg, first_pass, samples, every, folder)
    notes += depth_notes + mask_notes
    shade = None
    if relative:
        images, usable = (
            [f.rgb_u8 for f in samples],
            [geometry.inside & ~tools(f.index).tool_mask & ~first_pass.hidden(f.index, f.rgb_u8) for f in samples],
        )
        if measure is None:
            shade = fit_shading(images, usable, cfg.working_distance_mm).depth
        else:
            measure = _scaled(measure, samples, usable, cfg)
        if not (cfg.known_length or cfg.shaft_mm):
            what = f"depth is relative ({source}), without a unit; its median is set to {cfg.working_distance_mm:g}"
            notes.append(ToDo(f"{what}. For mm use --known-length, a stereo video or measured depth"))
    elif kind == "folder" and measure is not None:
        notes += _check_unit(samples, [measure(frame) for frame in samples], geometry, cfg.initial_depth)
    wanted = _inside_body([frame.rgb_u8 for frame in samples] if cfg.drop_out_of_body else [])
    sources = {"images": f"video, {clip.layout}", "depth": source, "masks": mask_source}
    return FrameMethods(measure, shade, tools, first_pass.hidden, kind == "sgbm", wanted, sources, relative, notes)


def _counted(frames: Iterable[StereoFrame], geometry: FrameGeometry, count: int, progress: Progress) -> Iterator[Image]:
    """The left images (H, W, 3) of frames, rectified."""
    for done, frame in enumerate(frames, 1):
        yield geometry.image(frame.left)
        progress("looking for tools", done, count)


def _check_stereo(samples: list[MeasuredFrame], clip: Clip) -> list[str]:
    """Reject swapped cameras; return a note if the rows do not match."""
    pairs = [(frame.rgb_u8, frame.right_u8) for frame in samples if frame.right_u8 is not None]
    pairs = pairs[:: max(len(samples) // 3, 1)]
    orders = [stereo_order(*pair) for pair in pairs]
    if sum(order.swapped for order in orders) > len(orders) / 2:
        fix = "Remove --swap-eyes." if clip.swap else "Add --swap-eyes."
        shares = f"{orders[0].exchanged:.0%} of the image matches swapped, {orders[0].as_given:.0%} as given"
        raise input_error(clip.source.path, "the left camera first", f"the right one ({shares})", fix)
    offsets = np.array([vertical_offset_px(*pair) for pair in pairs])
    offset = float(np.median(offsets[np.isfinite(offsets)])) if np.isfinite(offsets).any() else 0.0
    if offset <= MAX_ROW_OFFSET_PX:
        return []
    fix = "Pass the calibration of this video, or --row-offset auto."
    return [f"the rows of the cameras are {offset:.1f} px apart; depth will be poor. {fix}"]


def _depth_kind(cfg: PrepareConfig, clip: Clip) -> DepthKind:
    """The depth method that --depth selects; InputError for --depth-relative without a depth folder."""
    if cfg.initial_depth == "auto":
        kind: DepthKind = "sgbm" if clip.stereo else "shading"
    elif cfg.initial_depth in ("none", "sgbm", "shading"):
        kind = cfg.initial_depth
    else:
        kind = "network" if cfg.initial_depth.partition(":")[0] == NETWORK else "folder"
    if cfg.depth_relative != "no" and kind != "folder":
        raise input_error("--depth-relative", "a folder with --depth", cfg.depth, "Remove --depth-relative.")
    return kind


def _measured_depth(
    kind: DepthKind, cfg: PrepareConfig, first_pass: FirstPass
) -> tuple[Measure | None, str, list[str]]:
    """A function that measures depth without a mask (mm, or relative values of a network), its name, and notes."""
    if kind in ("none", "shading"):
        return None, kind, []
    if kind == "sgbm":
        return _matched_depth(cfg, first_pass.geometry), "stereo: semi-global matching", []
    if kind == "network":
        from .networks import DepthNetwork  # imports torch

        network = DepthNetwork(cfg.initial_depth.partition(":")[2])
        return lambda frame: network.inverse_depth(frame.rgb_u8), "Depth Anything V2", []
    files, notes = match_files(
        Path(cfg.initial_depth), DEPTH_SUFFIXES, "depth", first_pass.indices, first_pass.image_names
    )
    if cfg.depth_relative == "no":
        if not cfg.depth_unit_mm:
            fix = "`--depth-unit-mm 1` for mm, `0.01` for 0.01 mm, `1000` for m; or `--depth-relative depth`."
            raise input_error("--depth-unit-mm", f"mm per unit of the files in {cfg.initial_depth}", "none", fix)
        some = evenly_spaced(len(first_pass.indices), FITTED_SAMPLES)
        notes += _check_stored([read_stored(files[first_pass.indices[i]]) for i in some])

    def read(path: Path, size: tuple[int, int]) -> NDArray:
        if cfg.depth_relative == "disparity":
            return read_values(path, size)
        relative = cfg.depth_relative == "depth"
        return read_depth_file(path, 1.0 if relative else cfg.depth_unit_mm, size, relative=relative)

    return lambda frame: first_pass.frame_of(lambda size: read(files[frame.index], size)), "user's files", notes


def _matched_depth(cfg: PrepareConfig, geometry: FrameGeometry) -> Measure:
    baseline, focal = geometry.baseline_mm, float(geometry.matrix[0, 0])
    if baseline is None:
        fix = "`--calibration FILE` with both cameras, or `--depth shading`."
        raise input_error("--depth sgbm", "two cameras and their calibration", "one camera", fix)

    def match(frame: MeasuredFrame) -> Depth:
        assert frame.right_u8 is not None
        return stereo_depth(frame.rgb_u8, frame.right_u8, focal, baseline, cfg.stereo)

    return match


def _scaled(measure: Measure, samples: list[MeasuredFrame], usable: list[Mask], cfg: PrepareConfig) -> Measure:
    """Relative values scaled to the working distance by constants of the clip."""
    kind = "depth" if cfg.depth_relative == "depth" else "disparity"
    scale = RelativeScale.fit(kind, [measure(frame) for frame in samples], usable, cfg.working_distance_mm)
    return lambda frame: scale.mm(measure(frame))


def _check_unit(samples: list[MeasuredFrame], depths: list[Depth], geometry: FrameGeometry, folder: str) -> list[str]:
    """Reject depth outside the range of an endoscope; return notes on implausible depth."""
    found = guess_unit((d, d > 0, f.rgb_u8, geometry.inside) for f, d in zip(samples, depths, strict=True))
    if found.unit in ("m", "0.01 mm"):
        fix = f"The values look like {found.unit}: multiply --depth-unit-mm by {found.mm_per_unit:g}."
        raise input_error("--depth-unit-mm", "tissue 20 to 250 mm away", f"{found.median:g} mm in {folder}", fix)
    note = ToDo(f"the depth unit may be wrong: {found.reason}. Check --depth-unit-mm.")
    return [] if found.unit == "mm" else [note]


def _check_stored(images: list[NDArray]) -> list[str]:
    """Notes on the numbers (H, W) of some depth files: 8 bits, and what stands for missing depth."""
    notes = []
    if all(image.dtype == np.uint8 for image in images):
        notes.append("the depth has at most 256 steps: 8-bit files are too coarse for motion in mm. Use 16-bit files.")
    filled = [np.isfinite(image) & (image > 0) & ~is_measured(image) for image in images]
    if any(each.any() for each in filled):
        least = min(float(image[each].min()) for image, each in zip(images, filled, strict=True) if each.any())
        share = float(np.mean([each.mean() for each in filled]))
        why = "they are far above the rest, or fill flat patches at the end of the range"
        notes.append(f"depth: numbers from {least:g} on count as missing, {share:.1%} of it: {why}")
    return notes


def _inside_body(images: list[Image]) -> Callable[[Image], bool]:
    """A function that tells whether an image has the usual color of these; any image has if there are none."""
    usual = np.median([color_share(image) for image in images], 0) if images else None
    return lambda rgb_u8: usual is None or bool(np.abs(color_share(rgb_u8) - usual).max() < COLOR_DISTANCE)


def measure_frames(
    stereo_frames: Iterable[StereoFrame],
    geometry: FrameGeometry,
    methods: FrameMethods,
    first: int,
    used: list[int],
    pool: Pool,
) -> Iterator[MeasuredFrame]:
    """Rectify the wanted frames and measure their depth, from position `first` on.

    Args:
        used: gets the position in the source of every wanted frame.
    """

    def rectified(seen: StereoFrame) -> tuple[MeasuredFrame, bool]:
        frame = MeasuredFrame.of(seen, geometry)
        return frame, methods.wanted(frame.rgb_u8)

    def wanted() -> Iterator[MeasuredFrame]:
        for frame, is_wanted in pool.map(rectified, stereo_frames):
            if is_wanted:
                used.append(frame.index)
                if len(used) > first:
                    yield replace(frame, position=len(used) - 1)

    def measured(frame: MeasuredFrame) -> MeasuredFrame:
        return replace(frame, depth=methods.measure(frame)) if methods.measure else frame

    yield from pool.map(measured, wanted())


def with_neighbors(frames: Iterable[MeasuredFrame]) -> Iterator[list[MeasuredFrame]]:
    """For each frame, the window centered on it: `REACH` frames on each side, fewer at both ends."""
    padded = chain(repeat(None, REACH), frames, repeat(None, REACH))
    window = deque(islice(padded, 2 * REACH), 2 * REACH + 1)
    for last in padded:
        window.append(last)
        sides = list(window)[:REACH], list(window)[REACH + 1 :]
        reach = min(REACH - side.count(None) for side in sides)
        yield [frame for frame in list(window)[REACH - reach : REACH + reach + 1] if frame is not None]


def write_frames(
    stereo_frames: Iterable[StereoFrame],
    geometry: FrameGeometry,
    methods: FrameMethods,
    files: FrameFiles,
    *,
    keep_right: bool,
    on_frame: Callable[[int], None],
) -> list[int]:
    """Write every wanted frame that `files` does not have yet.

    Args:
        on_frame: called after each frame with the number of frames written.
    Returns:
        Position in the source of each frame of the sequence.
    """
    done, used = files.count, []

    def finished(window: list[MeasuredFrame]) -> dict[str, bytes]:
        """The encoded files of the frame in the middle of a window."""
        frame = window[len(window) // 2]
        depth = frame.depth
        if methods.filter_in_time:
            depth = temporal_median([other.depth for other in window if other.depth is not None])
        tools = methods.tools(frame.index).tool_mask | ~geometry.inside | methods.hidden(frame.index, frame.rgb_u8)
        if methods.shade:
            depth = methods.shade(frame.rgb_u8, ~tools)
        if depth is not None:
            depth = np.where(geometry.inside, depth, np.float32(0))
        rgb_u8 = np.where(geometry.inside[..., None], frame.rgb_u8, np.uint8(0))
        return files.encoded(rgb_u8, tools, depth, frame.right_u8 if keep_right else None)

    with frame_threads(BYTES_PER_PIXEL * geometry.source_size[0] * geometry.source_size[1]) as pool:
        # After a resume, measure a few finished frames again: the temporal filter needs their depth.
        frames = measure_frames(stereo_frames, geometry, methods, max(done - REACH, 0), used, pool)
        windows = (each for each in with_neighbors(frames) if each[len(each) // 2].position >= done)
        for encoded in pool.map(finished, windows):
            files.append(encoded)
            on_frame(files.count)
    return used


def replace_by_carried(
    files: FrameFiles,
    segmenter: VideoSegmenter,
    inside: Mask,
    methods: FrameMethods,
    used: Sequence[int],
    progress: Progress,
) -> list[str]:
    """Replace the masks of all written frames, their depth from shading, and the source of the masks in `files.meta`.

    The frames are written first, with the masks of our own finder, because the segmenter goes through them in both
    directions. To call this again after an interruption gives the same files.

    Args:
        inside: (H, W) True inside the endoscope's image.
        methods: how depth follows from shading, if it depends on masks, and what frames hide.
        used: position of every frame in the source.
    Returns:
        Notes for the user, one line each.
    """
    from ..tool_masks.mask_store import MaskStore, read_state, write_state  # imports torch
    from ..tool_masks.video_segmenter import segment_sequence

    work = files.folder / WORK
    store = MaskStore(work / "masks", (files.meta.width, files.meta.height))
    if "rows" not in read_state(work):
        files.finish()  # a reader needs the description; it is written again at the end
        sequence, found_rows = load_sequence(files.folder, DataConfig(format="plain")), []
        for i, (mask, found) in enumerate(segment_sequence(sequence, segmenter, work / "work", progress=progress)):
            store.put(i, mask)
            found_rows.append(asdict(FrameRow.of(i, found)))
        write_state(work, {"rows": found_rows})
    for i in range(files.count):
        rgb_u8 = read_color(files.file("images", i))
        mask = store.mask(i) | ~inside | methods.hidden(used[i], rgb_u8)
        write_tool_mask(files.file("masks", i), mask)
        if methods.shade is not None:
            depth = np.where(inside, methods.shade(rgb_u8, ~mask), np.float32(0))
            save_png(files.file("depth", i), files.depth_units(depth))
    rows = list(read_state(work)["rows"])
    write_rows(files.folder, rows)
    source = found_source(sum(row.share > 0 for row in rows) / files.count, segmenter.name)
    files.meta = replace(files.meta, sources=files.meta.sources | {"masks": source})
    return [ToDo(f"masks: {source}. {HINT}")]
