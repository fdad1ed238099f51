"""From a video to a sequence folder: the one place of this package that acts."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

import cv2
import numpy as np

from ..core.checks import runs
from ..data import write_stir_tracks
from ..data.images import read_color, read_depth, read_tool_mask, save_png
from ..data.reading import complaint, kind_of
from ..data.stir import demand_stir_clip
from ..data.writer import FrameFiles, SequenceMeta
from ..footage.camera_motion import camera_motion
from ..footage.changes import find_changes
from .calibration_files import read_calibration
from .clip import Clip
from .config import PrepareConfig
from .frames import write_frames
from .makers import Chosen, choose_makers
from .poses import PosePath, Seen, estimate_poses, read_poses
from .survey import look_through, source_facts
from .view import View
from .work_folder import forget_plan, frames_done, work_folder

DEPTH_SCALE = 0.01
"""mm per unit of the 16-bit depth files: up to 655 mm."""
Progress = Callable[[str, int, int], None]
"""Called with what is being done, how much of it is done, and how much there is (0: not known)."""


@dataclass(frozen=True)
class Prepared:
    """What became of a video."""

    out: Path
    num_frames: int
    size: tuple[int, int]
    """(width, height), px."""
    remarks: list[str]
    """What the user should know, one line each."""


def prepare(
    video: Path, out: Path, cfg: PrepareConfig | None = None, progress: Progress = lambda what, done, total: None
) -> Prepared:
    """Write a sequence folder from a video; the same call goes on where an interrupted one stopped.

    Args:
        video: a file, or a folder of pictures.
        out: a new or empty folder; it appears when the sequence is complete.
    Raises:
        InputError: the video, or anything that the options name, cannot be used; nothing is left behind.
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
        survey = look_through(clip, cfg, calibration, str(cfg.calibration))
        chosen = choose_makers(cfg, clip, survey)
        meta = _meta(clip, survey.view, chosen)
        parts = ["images", "masks", *(["depth"] if cfg.depth != "none" else []), *(["right"] if cfg.keep_right else [])]
        files = FrameFiles(folder, meta, frames_done(folder, parts))
        write_frames(
            clip.shots(clip.selection()),
            survey.view,
            chosen.makers,
            files,
            keep_right=cfg.keep_right,
            on_frame=lambda done: progress("writing frames", done, len(survey.indices)),
        )
        if files.count < 2:
            hint = "Check --start, --end and --drop-out-of-body."
            raise complaint(video, "at least 2 frames that show the inside of a body", str(files.count), hint)
        progress("following the camera", 0, files.count)
        path, said = _camera_path(cfg, files, meta)
        unexplained = _unexplained(path, files)
        if path is not None and meta.depth_relative:
            _scale_depth(files, path)
        files.finish(None if path is None else path.camera_to_world, unexplained)
        if cfg.stir is not None:
            write_stir_tracks(cfg.stir, folder)
        remarks = [*survey.remarks, *chosen.remarks, *said]
        if len(unexplained):
            which = f"not explained by the camera or by what the rest shows: frames {runs(unexplained)}"
            remarks.append(f"{which}; --start and --end leave them out, if they stand together")
    return Prepared(out, files.count, survey.view.size, remarks)


def _meta(clip: Clip, view: View, chosen: Chosen) -> SequenceMeta:
    return SequenceMeta(
        width=view.size[0],
        height=view.size[1],
        fx=float(view.matrix[0, 0]),
        fy=float(view.matrix[1, 1]),
        cx=float(view.matrix[0, 2]),
        cy=float(view.matrix[1, 2]),
        frames_per_second=clip.frames_per_second,
        baseline_mm=view.baseline_mm,
        depth_scale=DEPTH_SCALE,
        depth_source=chosen.sources["depth"],
        depth_relative=chosen.relative,
        sources=chosen.sources,
    )


def _camera_path(cfg: PrepareConfig, files: FrameFiles, meta: SequenceMeta) -> tuple[PosePath | None, list[str]]:
    """Poses of the written frames, None for a camera that stands still, and what to say about them."""
    if cfg.poses not in ("auto", "still", "estimate"):
        return read_poses(Path(cfg.poses), files.count), []
    if cfg.poses == "still":
        return None, []
    motion = camera_motion(
        (read_color(files.file("images", i)) for i in range(files.count)),
        (~read_tool_mask(files.file("masks", i)) for i in range(files.count)),
    )
    if cfg.poses == "auto" and not motion.moving:
        return None, [f"the camera stands still: {motion.reason}"]
    if cfg.depth == "none":
        return None, [f"the camera moves: {motion.reason}; without depth its path cannot be estimated"]

    def seen(index: int) -> Seen:
        return Seen(
            read_color(files.file("images", index)),
            ~read_tool_mask(files.file("masks", index)),
            read_depth(files.file("depth", index), meta.depth_scale),
        )

    matrix = np.array([[meta.fx, 0, meta.cx], [0, meta.fy, meta.cy], [0, 0, 1]])
    path = estimate_poses(seen, files.count, matrix, relative_depth=meta.depth_relative)
    way = np.linalg.norm(path.camera_to_world[:, :3, 3], axis=1).max()
    unit = "mm (relative)" if meta.depth_relative else "mm"
    return path, [f"the camera moves: {motion.reason}; estimated path reaches {way:.0f} {unit} from its start"]


def _scale_depth(files: FrameFiles, path: PosePath) -> None:
    """Bring each frame's relative depth to the scale of the points that the camera's path was found by."""
    forget_plan(files.folder)
    for index, scale in enumerate(path.depth_scale):
        file = files.file("depth", index)
        stored = cv2.imread(str(file), cv2.IMREAD_UNCHANGED).astype(np.float64) * scale
        save_png(file, np.clip(np.round(stored), 0, 65535).astype(np.uint16))


def _unexplained(path: PosePath | None, files: FrameFiles) -> list[int]:
    """Frames without a pose of their own, and frames that show another place than the rest."""
    lost = set() if path is None else set(np.flatnonzero(~path.explained).tolist())
    changes = find_changes(read_color(files.file("images", i)) for i in range(files.count))
    return sorted(lost | set(changes.off_color))
