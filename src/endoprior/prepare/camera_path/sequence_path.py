"""The camera path of written frames, as `prepare` and `poses` want it: static, estimated, or from a file."""

from __future__ import annotations

from collections.abc import Callable, Iterable
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from ...core.checks import number_ranges
from ...core.geometry import length_unit
from ...footage.camera_motion import camera_motion
from ...footage.changes import find_changes
from .choose import How, find_path
from .follow import follow_camera
from .given import with_poses
from .pose_file import GivenPoses, read_poses
from .seen import CameraPath, Lens, PoseInput

PATH_RECORD = "camera_path.json"
"""In a sequence folder: how each pose was found, and how sure it is."""
ASSUMED, CALIBRATED, REFINED = "assumed field of view", "calibration", "refined with the camera path"
"""Where the focal length comes from: `sources.lens` of `sequence.json`."""
METHODS: dict[str, How] = {"auto": "best", "auto-own": "own", "estimate": "best", "own": "own", "colmap": "colmap"}
"""Values of --poses that estimate a path; `still` and files do not."""
ONLY_IF_MOVING = ("auto", "auto-own")
"""Those that do so only where the camera moves."""
WITHOUT_COLMAP = {"auto": "auto-own", "estimate": "own", "colmap": "own"}
"""The same by our own tracks alone, which is ten times faster."""


def sequence_path(
    how: str,
    frame: Callable[[int], PoseInput],
    views: Callable[[], tuple[Iterable[NDArray[np.uint8]], Iterable[NDArray[np.bool_]]]],
    count: int,
    lens: Lens,
    size: tuple[int, int],
    *,
    has_depth: bool,
    refine_focal: bool,
    given: GivenPoses | None = None,
    progress: Callable[[int], None] = lambda done: None,
) -> tuple[CameraPath | None, list[str]]:
    """The path, None for a static camera; and notes for the user.

    Args:
        how: a name of `METHODS`, `still`, or a file of poses.
        frame: reads frame i.
        views: opens all images and all tissue masks, one after the other.
        lens: its focal length may be an assumption: `refine_focal`.
        size: (width, height), px.
        given: what the poses of a file belong to, if that is not the frames themselves.
    Raises:
        InputError: the file of poses cannot be used, or COLMAP is asked for and not there.
    """
    if how == "still":
        return None, []
    if how not in METHODS:
        poses = read_poses(Path(how), count, given)
        path = _from_file(poses, frame, lens, progress) if has_depth else _unscaled(poses)
        return path, [given.note] if given is not None and given.note else []
    motion = camera_motion(*views())
    if how in ONLY_IF_MOVING and not motion.moving:
        return None, [f"the camera is static: {motion.reason}"]
    if not has_depth:
        return None, [f"the camera moves: {motion.reason}; without depth its path cannot be estimated"]
    path = find_path(frame, count, lens, size, METHODS[how], refine_focal=refine_focal, progress=progress)
    return path, [f"the camera moves: {motion.reason}; {_reach(path, lens)}", *_quality(path, lens), *path.notes]


def record_of_path(path: CameraPath) -> dict[str, Any]:
    """What `camera_path.json` holds."""

    def numbers(values: NDArray | None) -> list[float | None]:
        found = np.full(len(path.explained), np.nan) if values is None else values
        return [round(float(v), 5) if np.isfinite(v) else None for v in found]

    return {
        "method": path.method,
        "focal_factor": round(path.focal_factor, 5),
        "explained": path.explained.tolist(),
        "still": [] if path.still is None else path.still.tolist(),
        "translation_std_mm": numbers(path.translation_std),
        "rotation_std_degrees": numbers(path.rotation_std),
        "depth_scale": [round(float(v), 6) for v in path.depth_scale],
    }


def sources_with(sources: dict[str, str], path: CameraPath) -> dict[str, str]:
    """`sources` of `sequence.json` with those of a path."""
    return sources | {"poses": path.method} | ({"lens": REFINED} if path.focal_factor != 1 else {})


def unexplained_frames(path: CameraPath | None, images: Iterable[NDArray[np.uint8]]) -> list[int]:
    """Frames without an estimated pose, and frames whose color differs from the rest."""
    lost = set() if path is None else set(np.flatnonzero(~path.explained).tolist())
    return sorted(lost | set(find_changes(images).off_color))


def rescaled(stored: NDArray, scale: float) -> NDArray[np.uint16]:
    """Stored depth times a factor; 0, missing, stays."""
    return np.clip(np.round(stored.astype(np.float64) * scale), 0, 65535).astype(np.uint16)


def _from_file(
    poses: NDArray, frame: Callable[[int], PoseInput], lens: Lens, progress: Callable[[int], None]
) -> CameraPath:
    """The given poses; relative depth gets the scale at which its points agree with them."""
    if not lens.depth_is_relative:
        return _unscaled(poses)
    follower = follow_camera(frame, len(poses), lens, progress)
    world = with_poses(follower, np.linalg.inv(poses), np.ones(len(poses), bool))
    return replace(_unscaled(poses), depth_scale=world.scales)


def _unscaled(poses: NDArray) -> CameraPath:
    return CameraPath(poses, np.ones(len(poses), bool), np.ones(len(poses)))


def _reach(path: CameraPath, lens: Lens) -> str:
    centers = path.camera_to_world[:, :3, 3]
    reach, unit = np.linalg.norm(centers - centers[0], axis=1).max(), length_unit(lens.depth_is_relative)
    return f"the estimated path reaches {reach:.0f} {unit} from its start"


def _quality(path: CameraPath, lens: Lens) -> list[str]:
    """How sure the path is, where the camera rests, and the focal length if it was refined."""
    notes = []
    if path.translation_std is not None and path.rotation_std is not None and np.isfinite(path.translation_std).any():
        unit, moved, turned = (
            length_unit(lens.depth_is_relative),
            *map(np.nanmedian, (path.translation_std, path.rotation_std)),
        )
        notes.append(
            f"camera pose, standard deviation (median of the frames): {moved:.2f} {unit}, {turned:.3f} degrees"
        )
    if path.still is not None and path.still.any():
        notes.append(f"the camera rests in frames {number_ranges(np.flatnonzero(path.still).tolist())}")
    if path.focal_factor != 1:
        old = lens.matrix[0, 0]
        notes.append(f"focal length refined with the path: {old * path.focal_factor:.0f} px in place of {old:.0f} px")
    return notes
