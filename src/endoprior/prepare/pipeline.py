"""`prepare`: run all steps that turn a video into a sequence folder."""

from __future__ import annotations

import math
import os
import shutil
from collections.abc import Callable, Collection, Sequence
from contextlib import AbstractContextManager
from dataclasses import dataclass, replace
from pathlib import Path
from typing import TYPE_CHECKING

import cv2
import numpy as np
from numpy.typing import NDArray

from ..core.checks import frame_list, input_error
from ..core.shell import changed_options, command, quoted
from ..data import write_stir_tracks
from ..data.description import PATH_RECORD, SIZE_NOT_STATED, PrepareRecord
from ..data.files import CONFIDENCE
from ..data.found_tools import FrameRow, mark_moving, read_rows, uncertain_frames, write_rows
from ..data.image_folders import contents_of
from ..data.images import decode_image, read_color, read_depth, read_tool_mask, save_png
from ..data.load import not_to_prepare
from ..data.stir import demand_stir_clip
from ..data.writer import FrameFiles, SequenceMeta
from ..footage.known_facts import KnownFacts
from ..system.console import ToDo
from ..system.memory import BoundedCache, cache_bytes
from ..system.parallel import Pool, frame_threads
from .calibration import parse_size
from .calibration_files import read_calibration
from .camera_path.path import CameraPath
from .camera_path.sequence_path import ASSUMED, CALIBRATED, Reading, path_depth, sequence_path
from .camera_path.tracks import FrameReader, TrackingCamera
from .config import PrepareConfig, is_sam2, names_path
from .first_pass import FirstPass, input_facts, run_first_pass, source_facts
from .frame_geometry import FrameGeometry, with_equal_rows
from .frame_tools import FOUND, masked_frames
from .frames import WORK, FrameMethods, choose_methods, replace_by_carried, write_frames
from .parallax import measure_depth
from .scale import check_scale_options, demand_no_unit, use_scale
from .source import ASSUMED_RATE
from .video_clip import Clip
from .work_folder import delete_plan, frames_done, work_folder

if TYPE_CHECKING:
    from ..tool_masks.video_segmenter import VideoSegmenter

BYTES_PER_PX = 100  # memory in which a thread measures a written frame, bytes for each px
DEPTH_SCALE = 0.01  # mm per unit of the 16-bit depth files: up to 655 mm
GRID_POINTS = 9  # points a side of the grid over a rectified frame; between them the rectification is nearly linear
Progress = Callable[[str, int, int], None]
"""Called with the name of the step, the number of items done, and their total (0: unknown)."""


@dataclass(frozen=True)
class Prepared:
    """Result of `prepare`."""

    out: Path
    num_frames: int
    size: tuple[int, int]
    """(width, height), px."""
    notes: list[str]
    """Notes for the user, one line each."""


class _Written(FrameFiles):
    """The frames of a sequence, to read again."""

    def __init__(self, folder: Path, meta: SequenceMeta, count: int = 0) -> None:
        super().__init__(folder, meta, count)
        self.used: list[int] = []  # position in the source of each frame
        self._colors: BoundedCache[NDArray[np.uint8]] = BoundedCache(cache_bytes(), lambda image: image.nbytes)

    def color(self, index: int) -> NDArray[np.uint8]:
        return self._colors.get(index, lambda: read_color(self.file("images", index)))

    def tools(self, index: int) -> NDArray[np.bool_]:
        return read_tool_mask(self.file("masks", index))

    def tissue(self, index: int) -> NDArray[np.bool_]:
        return ~self.tools(index)

    def depth(self, index: int) -> NDArray[np.float32]:
        return read_depth(self.file("depth", index), self.meta.depth_scale)

    @property
    def reader(self) -> FrameReader:
        return FrameReader(self.color, self.tissue, self.depth, self.count)

    def camera(self, *, focal_is_assumed: bool) -> TrackingCamera:
        meta = self.meta
        size, relative = (meta.width, meta.height), meta.depth_relative
        return TrackingCamera.centered_at_half(meta.matrix, size, relative, meta.baseline_mm, focal_is_assumed)

    def frame_threads(self) -> AbstractContextManager[Pool]:
        """Threads that measure written frames."""
        return frame_threads(BYTES_PER_PX * self.meta.width * self.meta.height)


@dataclass(frozen=True)
class _FrameMarks:
    """Which frames cannot be trained on, and how much the others count."""

    damaged: list[int]
    unexplained: list[int]  # damaged, without a pose, or of another scene than the frames that are not damaged
    weights: NDArray[np.float64]  # (T,) less than 1 where smoke or blur lies on a frame

    @property
    def without_pose(self) -> list[int]:
        """Not damaged, but without a pose or of another scene."""
        return sorted({*self.unexplained} - {*self.damaged})


def prepare(
    video: str | Path,
    out: str | Path,
    cfg: PrepareConfig | None = None,
    progress: Progress = lambda _what, _done, _total: None,
    facts: KnownFacts | None = None,
) -> Prepared:
    """Write a sequence folder from a video. The same call resumes after an interruption.

    Args:
        video: a file, or a folder of images, or one with such a folder and perhaps one of masks.
        out: a new or empty folder; it appears when the sequence is complete.
        facts: gets facts of the frames, for steps that come later.
    Raises:
        InputError: the video, or a file named by an option, cannot be used; nothing is left behind.

    Example:
        >>> import endoprior
        >>> prepared = endoprior.prepare("DATA/images", "PREPARED")
        >>> len(endoprior.load_sequence("PREPARED"))
        10
    """
    video, out = Path(video), Path(out)
    cfg, facts = cfg or PrepareConfig(), facts or KnownFacts()
    if error := not_to_prepare(video):
        raise error
    cfg, own_notes = _with_own_files(video, cfg)
    check_scale_options(cfg.known_length, cfg.shaft_mm)
    if cfg.stir is not None:
        demand_stir_clip(cfg.stir)
        _demand_all_frames(cfg)
    segmenter = _open_segmenter(cfg)
    plan = {"config": repr(cfg), "sources": [source_facts(video), *input_facts(cfg).values()]}
    with work_folder(out, plan) as folder:
        clip, first_pass, step = _measure_clip(video, cfg, progress)
        methods = choose_methods(cfg, clip, first_pass, folder, progress)
        demand_no_unit(cfg.known_length, cfg.shaft_mm, methods.relative)
        files = _write(folder, cfg, clip, first_pass, methods, step, progress)
        mask_notes, moving = _complete_masks(files, cfg, segmenter, methods, first_pass.geometry.inside, progress)
        path, path_notes = _camera_path(files, cfg, clip, first_pass, facts, progress)
        marks = _mark_frames(files, path, first_pass.damaged, facts)
        if path is not None:
            _use_path(files, path)
        depth_notes = _use_parallax(files, path, video, cfg, progress)
        path, scale_notes = use_scale(files, files.reader, path, cfg.known_length, cfg.shaft_mm)
        video_notes = [*first_pass.video_notes, *_usage_notes(marks, len(first_pass.indices) - len(files.used))]
        _finish(files, path, marks, _record(video, cfg, first_pass.geometry, video_notes), cfg.stir)
        notes = [*own_notes, *video_notes, *first_pass.notes, *methods.notes]
        notes += [*mask_notes, *path_notes, *depth_notes, *scale_notes, *_advice(out, files, path, marks, moving)]
    return Prepared(out, files.count, first_pass.geometry.size, notes)


def _open_segmenter(cfg: PrepareConfig) -> VideoSegmenter | None:
    if not is_sam2(cfg.masks):
        return None
    from .networks import open_sam2  # imports torch

    return open_sam2(cfg.masks, "--masks")


def _with_own_files(video: Path, cfg: PrepareConfig) -> tuple[PrepareConfig, list[str]]:
    """The options, with masks and calibration of a folder of images unless others are asked for; and notes."""
    found, notes = contents_of(video), list[str]()
    if found and cfg.masks == "auto" and (masks := found.masks):
        other = f"For none: `--masks none`; to have tools found: pass {quoted(found.images)}"
        notes.append(f"masks: those in {masks} are used. {other}")
        cfg = replace(cfg, masks=str(masks))
    if found and found.frames_per_second is None and cfg.folder_rate is None:
        what = f"the frame rate of {found.images} is unknown, {ASSUMED_RATE:g}/s assumed"
        notes.append(ToDo(f"{what}: --folder-rate sets it"))
    if found and found.calibration and cfg.calibration is None:
        notes.append(f"calibration: that of {found.calibration}")
        cfg = replace(cfg, calibration=found.calibration)
    return cfg, notes


def _measure_clip(video: Path, cfg: PrepareConfig, progress: Progress) -> tuple[Clip, FirstPass, int]:
    """The clip, what a first pass over it found, and the usual distance between the frames that are used."""
    calibration = read_calibration(cfg.calibration, cfg.calibration_unit) if cfg.calibration else None
    if calibration is not None and cfg.calibration_size:
        calibration = replace(calibration, size=parse_size(cfg.calibration_size), size_is_sure=True)
    clip = Clip(video, cfg, calibration)
    progress("looking through", 0, clip.source.num_frames)
    first_pass = run_first_pass(clip, cfg)
    step = 1
    if masked := masked_frames(cfg, first_pass):
        clip.only, step, note = masked
        first_pass = run_first_pass(clip, cfg)
        first_pass.notes.append(note)
    if cfg.row_offset == "auto":
        pairs = [(frame.left, frame.right) for frame in first_pass.samples]
        first_pass.geometry, row_note = with_equal_rows(first_pass.geometry, pairs)
        first_pass.notes.append(row_note)
    if cfg.border == "auto":
        progress("looking for text", 0, len(first_pass.indices))
        first_pass.find_text(clip)
    return clip, first_pass, step


def _write(
    folder: Path, cfg: PrepareConfig, clip: Clip, first_pass: FirstPass, methods: FrameMethods, step: int,
    progress: Progress,
) -> _Written:  # fmt: skip
    """Write the frames that are not there yet; InputError if they are too few for a sequence."""
    parts = ["images", "masks", *(["depth"] if cfg.depth != "none" else []), *(["right"] if cfg.keep_right else [])]
    files = _Written(folder, _meta(clip, first_pass, methods, step), frames_done(folder, parts))
    files.used = write_frames(
        first_pass.all_frames(clip),
        first_pass.geometry,
        methods,
        files,
        keep_right=cfg.keep_right,
        on_frame=lambda done: progress("writing frames", done, len(first_pass.indices)),
    )
    first_pass.frames = None  # frees memory: they are read from files now
    if files.count < 2:
        fix = "Change --start, --end or --drop-out-of-body."
        want = "at least 2 frames that show the inside of a body"
        raise input_error(clip.source.path, want, str(files.count), fix)
    if cfg.masks == "auto":
        write_rows(folder, (FrameRow.of(i, methods.tools(index)) for i, index in enumerate(files.used)))
    return files


def _meta(clip: Clip, first_pass: FirstPass, methods: FrameMethods, step: int) -> SequenceMeta:
    geometry, lens = first_pass.geometry, ASSUMED
    if clip.calibration is not None:
        lens = CALIBRATED if clip.calibration.size else SIZE_NOT_STATED
    return SequenceMeta(
        *geometry.size,
        *geometry.matrix[[0, 1, 0, 1], [0, 1, 2, 2]].tolist(),
        frames_per_second=clip.frames_per_second / step,
        baseline_mm=geometry.baseline_mm,
        depth_scale=DEPTH_SCALE,
        depth_source=methods.sources["depth"],
        depth_relative=methods.relative,
        sources=methods.sources | {"lens": lens},
    )


def _complete_masks(
    files: _Written, cfg: PrepareConfig, segmenter: VideoSegmenter | None, methods: FrameMethods,
    inside: NDArray[np.bool_], progress: Progress,
) -> tuple[list[str], list[int]]:  # fmt: skip
    """Have a segmenter follow the tools, if it is asked for; notes for the user, and frames in which something moves
    that no mask covers.
    """
    notes, moving = [], []
    if segmenter is not None:
        notes = replace_by_carried(files, segmenter, inside, methods, files.used, progress)
    if cfg.masks == "auto" or segmenter is not None:
        from .unmasked_motion import frames_with_unmasked_motion  # imports torch

        rate = files.meta.frames_per_second
        with files.frame_threads() as pool:
            moving = frames_with_unmasked_motion(files.count, rate, files.color, files.tools, inside, pool.map)
    mark_moving(files.folder, moving)
    return notes, moving


def _camera_path(
    files: _Written, cfg: PrepareConfig, clip: Clip, first_pass: FirstPass, facts: KnownFacts, progress: Progress
) -> tuple[CameraPath | None, list[str]]:
    """Poses of the written frames, None for a static camera; and notes for the user."""
    progress("following the camera", 0, files.count)
    turn = first_pass.geometry.turn
    reading = Reading(
        cfg.poses_convention,
        cfg.poses_unit_mm,
        # Poses of a file are those of the source's left camera, which rectification turns.
        turn=None if np.array_equal(turn, np.eye(3)) else turn,
        sources=files.used,
        image_times=clip.source.times,
        image_names=first_pass.image_names,
    )
    return sequence_path(
        cfg.poses,
        files.reader,
        files.camera(focal_is_assumed=cfg.calibration is None),
        has_depth=cfg.depth != "none",
        reading=reading,
        progress=lambda done: progress("following the camera", done, files.count),
        facts=facts,
    )


def _mark_frames(
    files: _Written, path: CameraPath | None, damaged_in_source: Collection[int], facts: KnownFacts
) -> _FrameMarks:
    damaged = [i for i, index in enumerate(files.used) if index in damaged_in_source]
    whole, weights = sorted({*range(files.count)} - {*damaged}), np.ones(files.count)
    if len(whole) < files.count / 2:  # too few to tell which scene is the usual one
        return _FrameMarks(damaged, damaged, weights)
    with files.frame_threads() as pool:
        changes = facts.find_changes(lambda: pool.map(files.color, whole), pool.map)
    weights[whole] = changes.weights
    other_scene = [whole[i] for i in changes.off_color]
    return _FrameMarks(damaged, sorted({*damaged, *(path.lost if path else []), *other_scene}), weights)


def _use_path(files: FrameFiles, path: CameraPath) -> None:
    """Bring relative depth and the focal length to those of the path, and record it."""
    if files.meta.depth_relative:
        delete_plan(files.folder)  # to scale depth twice would be wrong
        for index in range(files.count):
            file = files.file("depth", index)
            save_png(file, path_depth(path, index, decode_image(file, None), files.meta.depth_scale))
    fx, fy = files.meta.fx * path.focal_factor, files.meta.fy * path.focal_factor
    files.meta = replace(files.meta, fx=fx, fy=fy, sources=path.sources(files.meta.sources))
    files.write_json(PATH_RECORD, path.record())


def _use_parallax(
    files: _Written, path: CameraPath | None, video: Path, cfg: PrepareConfig, progress: Progress
) -> list[str]:
    """Measure relative depth by the motion of the camera where it tells, and bend the depth of the frames to it."""
    if not (cfg.demands_motion or (cfg.depth == "auto" and files.meta.depth_relative)):
        return []
    meta, doubt, found = files.meta, "the camera is still, or its path is unknown", None
    if path is not None and not path.is_unknown:
        found = measure_depth(
            files.reader,
            files.camera(focal_is_assumed=False),
            np.linalg.inv(path.camera_to_world),
            path.explained,
            files.folder / WORK,
            lambda done: progress("depth by parallax", done, files.count),
        )
        doubt = found.doubt
    if cfg.demands_motion and doubt:
        raise input_error(video, "a camera whose motion tells the depth", doubt, f"Use `--depth {cfg.initial_depth}`.")
    if found is None or doubt:
        return [] if found is None else [f"depth is not measured by the motion of the camera: {doubt}"]
    delete_plan(files.folder)  # to bend depth twice would be wrong

    def bend(index: int) -> tuple[int, NDArray[np.uint16], NDArray[np.uint8]]:
        return (
            index,
            files.depth_units(found.depth(index, files.depth(index))),
            found.confidence_of(index, (meta.width, meta.height)),
        )

    with files.frame_threads() as pool:
        for index, units, confidence in pool.map(bend, range(files.count)):
            save_png(files.file("depth", index), units)
            files.write_image(CONFIDENCE, confidence, index)
    source = f"parallax on {found.share:.0%} of the tissue, filled by {meta.depth_source}"
    files.meta = replace(meta, depth_source=source, sources=meta.sources | {"depth": source})
    return [f"depth is measured by the motion of the camera: {source}"]


def _finish(
    files: _Written, path: CameraPath | None, marks: _FrameMarks, record: PrepareRecord, stir: Path | None
) -> None:
    """Describe the sequence, and delete what was needed on the way."""
    shutil.rmtree(files.folder / WORK, ignore_errors=True)
    (files.folder / FOUND).unlink(missing_ok=True)
    files.finish(None if path is None else path.camera_to_world, marks.unexplained, marks.weights.tolist())
    record.save(files.folder)
    if stir is not None:
        write_stir_tracks(stir, files.folder)


def _usage_notes(marks: _FrameMarks, outside: int) -> list[str]:
    notes = []
    if marks.damaged:
        what = "damaged in the video, or predicted from damaged images before the next key frame"
        fix = "leave them out with --start and --end, or copy the video again"
        where = f"{frame_list(marks.damaged)}. They are unexplained_frames of sequence.json"
        notes.append(ToDo(f"{what}: {where}; {fix}"))
    if outside:
        notes.append(f"{outside} frames without the color of the inside of a body are left out")
    return notes


def _advice(out: Path, files: _Written, path: CameraPath | None, marks: _FrameMarks, moving: list[int]) -> list[str]:
    """Notes on frames to look at: of unsure masks, of likely missed tools, without a pose."""
    notes, correct = [], f"To look and correct: {command('view', out)}"
    if uncertain := uncertain_frames(read_rows(files.folder)):
        notes.append(f"masks: unsure in {frame_list(uncertain)}. {correct}")
    if moving:
        what = f"in {frame_list(moving)}, something moves that no mask covers"
        notes.append(f"masks: tools are likely missed: {what}. {correct}")
    is_noted = path is not None and path.is_unknown and not path.explained.any()  # by the note on the motion
    if marks.without_pose and not is_noted:
        usable = files.count - len(marks.unexplained)
        fix = "look at the images: is this one video?" if usable < 2 else "--start and --end can leave them out"
        notes.append(f"no camera pose, or another scene, in {frame_list(marks.without_pose)}; {fix}")
    return notes


def _demand_all_frames(cfg: PrepareConfig) -> None:
    """Raise InputError if options leave out frames: points of STIR belong to the first and the last frame of a clip."""
    options = {"--start": cfg.start > 0, "--end": cfg.end < math.inf, "--drop-out-of-body": cfg.drop_out_of_body}
    if left_out := [name for name, is_set in options.items() if is_set]:
        raise input_error("--stir", "all frames of the clip", left_out[0], f"remove {left_out[0]}.")


def _record(video: Path, cfg: PrepareConfig, geometry: FrameGeometry, video_notes: Sequence[str]) -> PrepareRecord:
    """What is kept of the call, so that the command can be repeated. Args: video_notes: what `check` repeats."""
    options = changed_options(cfg)
    for name in ("--depth", "--masks", "--poses"):
        if name in options:
            options[name] = (_absolute(options[name][0]),)
    source, grid = os.path.abspath(video), _source_px(geometry)
    return PrepareRecord(source, options, geometry.source_size, grid, tuple(video_notes))


def _absolute(value: str) -> str:
    """A method, or the absolute path of a file or folder."""
    if names_path(value):
        return os.path.abspath(value)
    method, colon, folder = value.partition(":")  # a folder, or the name of a network on a server
    return f"{method}:{os.path.abspath(folder)}" if colon and os.path.isdir(folder) else value


def _source_px(geometry: FrameGeometry) -> tuple[tuple[tuple[float, ...], ...], ...]:
    """Where an even grid over the frame lies in the source image, px; a pixel is 1 wide and its center at a half."""
    x, y, width, height = geometry.cut
    count = 2 if geometry.maps[0] is None else GRID_POINTS
    columns, rows = np.meshgrid(np.linspace(x, x + width, count), np.linspace(y, y + height, count))
    grid = np.stack([columns, rows], -1)
    if geometry.maps[0] is not None:
        # The maps have one entry for each pixel, at its center, and count centers from 0.
        at = (columns - 0.5).astype(np.float32), (rows - 0.5).astype(np.float32)
        maps = [cv2.remap(of, *at, cv2.INTER_LINEAR, borderMode=cv2.BORDER_REPLICATE) for of in geometry.maps[0]]
        grid = np.stack(maps, -1) + 0.5
    return tuple(tuple(tuple(round(float(v), 2) for v in point) for point in row) for row in grid)
