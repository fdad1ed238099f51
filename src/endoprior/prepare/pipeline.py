"""`prepare`: run all steps that turn a video into a sequence folder."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from ..core.checks import input_error, number_ranges
from ..core.geometry import length_unit
from ..data import write_stir_tracks
from ..data.images import decode_image, read_color, read_depth, read_tool_mask, save_png
from ..data.reading import kind_of
from ..data.stir import demand_stir_clip
from ..data.writer import FrameFiles, SequenceMeta
from ..footage.camera_motion import camera_motion
from ..footage.changes import find_changes
from .calibration_files import read_calibration
from .config import PrepareConfig
from .depth_and_masks import ChosenMethods, choose_methods
from .first_pass import run_first_pass, source_facts
from .frame_geometry import FrameGeometry
from .frames import write_frames
from .poses import PoseInput, PosePath, estimate_poses, read_poses
from .record import record_of
from .video_clip import Clip
from .work_folder import delete_plan, frames_done, work_folder

DEPTH_SCALE = 0.01
"""mm per unit of the 16-bit depth files: up to 655 mm."""
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


def prepare(
    video: Path, out: Path, cfg: PrepareConfig | None = None, progress: Progress = lambda what, done, total: None
) -> Prepared:
    """Write a sequence folder from a video. The same call resumes after an interruption.

    Args:
        video: a file, or a folder of images.
        out: a new or empty folder; it appears when the sequence is complete.
    Raises:
        InputError: the video, or a file named by an option, cannot be used; nothing is left behind.
    """
    cfg = cfg or PrepareConfig()
    named = [video, cfg.right, cfg.calibration, cfg.stir, Path(cfg.masks), Path(cfg.depth), Path(cfg.poses)]
    there = [path for path in named if path and kind_of(path) != "nothing"]
    if cfg.stir is not None:
        demand_stir_clip(cfg.stir)
    plan = {"config": repr(cfg), "sources": [source_facts(path) for path in there]}
    with work_folder(out, plan) as folder:
        calibration = read_calibration(cfg.calibration, cfg.calibration_unit) if cfg.calibration else None
        clip = Clip(video, cfg, calibration)
        progress("looking through", 0, clip.source.num_frames)
        first_pass = run_first_pass(clip, cfg, calibration, str(cfg.calibration))
        progress("learning tools and light", 0, len(first_pass.indices))
        chosen = choose_methods(cfg, clip, first_pass)
        meta = _meta(clip, first_pass.geometry, chosen)
        parts = ["images", "masks", *(["depth"] if cfg.depth != "none" else []), *(["right"] if cfg.keep_right else [])]
        files = FrameFiles(folder, meta, frames_done(folder, parts))
        write_frames(
            clip.stereo_frames(clip.selection()),
            first_pass.geometry,
            chosen.methods,
            files,
            keep_right=cfg.keep_right,
            on_frame=lambda done: progress("writing frames", done, len(first_pass.indices)),
        )
        if files.count < 2:
            fix = "Change --start, --end or --drop-out-of-body."
            raise input_error(video, "at least 2 frames that show the inside of a body", str(files.count), fix)
        progress("following the camera", 0, files.count)
        path, motion_notes = _camera_path(cfg, files, meta)
        unexplained = _unexplained(path, files)
        if path is not None and meta.depth_relative:
            _scale_depth(files, path)
        files.finish(None if path is None else path.camera_to_world, unexplained)
        record_of(video, cfg, first_pass.geometry).save(folder)
        if cfg.stir is not None:
            write_stir_tracks(cfg.stir, folder)
        notes = [*first_pass.notes, *chosen.notes, *motion_notes]
        if unexplained:
            frames = number_ranges(unexplained)
            notes.append(f"no camera pose, or another scene, in frames {frames}; --start and --end can leave them out")
    return Prepared(out, files.count, first_pass.geometry.size, notes)


def _meta(clip: Clip, geometry: FrameGeometry, chosen: ChosenMethods) -> SequenceMeta:
    return SequenceMeta(
        width=geometry.size[0],
        height=geometry.size[1],
        fx=float(geometry.matrix[0, 0]),
        fy=float(geometry.matrix[1, 1]),
        cx=float(geometry.matrix[0, 2]),
        cy=float(geometry.matrix[1, 2]),
        frames_per_second=clip.frames_per_second,
        baseline_mm=geometry.baseline_mm,
        depth_scale=DEPTH_SCALE,
        depth_source=chosen.sources["depth"],
        depth_relative=chosen.relative,
        sources=chosen.sources,
    )


def _camera_path(cfg: PrepareConfig, files: FrameFiles, meta: SequenceMeta) -> tuple[PosePath | None, list[str]]:
    """Poses of the written frames, None for a static camera; and notes for the user."""
    if cfg.poses not in ("auto", "still", "estimate"):
        return read_poses(Path(cfg.poses), files.count), []
    if cfg.poses == "still":
        return None, []
    motion = camera_motion(
        (read_color(files.file("images", i)) for i in range(files.count)),
        (~read_tool_mask(files.file("masks", i)) for i in range(files.count)),
    )
    if cfg.poses == "auto" and not motion.moving:
        return None, [f"the camera is static: {motion.reason}"]
    if cfg.depth == "none":
        return None, [f"the camera moves: {motion.reason}; without depth its path cannot be estimated"]

    def load(index: int) -> PoseInput:
        return PoseInput(
            read_color(files.file("images", index)),
            ~read_tool_mask(files.file("masks", index)),
            read_depth(files.file("depth", index), meta.depth_scale),
        )

    matrix = np.array([[meta.fx, 0, meta.cx], [0, meta.fy, meta.cy], [0, 0, 1]])
    path = estimate_poses(load, files.count, matrix, relative_depth=meta.depth_relative)
    reach = np.linalg.norm(path.camera_to_world[:, :3, 3], axis=1).max()
    unit = length_unit(meta.depth_relative)
    return path, [f"the camera moves: {motion.reason}; the estimated path reaches {reach:.0f} {unit} from its start"]


def _scale_depth(files: FrameFiles, path: PosePath) -> None:
    """Rescale the relative depth of each frame to agree with the tracked points of the pose estimation."""
    delete_plan(files.folder)
    for index, scale in enumerate(path.depth_scale):
        file = files.file("depth", index)
        stored = decode_image(file, None).astype(np.float64) * scale
        save_png(file, np.clip(np.round(stored), 0, 65535).astype(np.uint16))


def _unexplained(path: PosePath | None, files: FrameFiles) -> list[int]:
    """Frames without an estimated pose, and frames whose color differs from the rest."""
    lost = set() if path is None else set(np.flatnonzero(~path.explained).tolist())
    changes = find_changes(read_color(files.file("images", i)) for i in range(files.count))
    return sorted(lost | set(changes.off_color))
