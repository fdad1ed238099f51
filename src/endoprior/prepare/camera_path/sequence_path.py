"""The camera path of written frames, as `prepare` and `poses` want it: static, estimated, or from a file."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from ...core.checks import input_error, number_ranges
from ...core.geometry import Convention, length_unit, to_ours
from ...data.writer import FARTHEST_UNIT
from ...footage.camera_motion import camera_motion
from ...footage.pose_fit import View, measure_poses
from .choose import How, find_path
from .colmap import with_poses
from .follow import follow_camera
from .pose_file import is_model, read_model_poses, read_poses
from .tracks import CameraPath, Lens, PoseInput

NEGLIGIBLE_DEGREES = 1e-3
PATH_RECORD = "camera_path.json"  # in a sequence folder: how each pose was found, and how sure it is
ASSUMED, CALIBRATED = "assumed field of view", "calibration"
"""Where the focal length comes from: `sources.lens` of `sequence.json`."""
METHODS: dict[str, How] = {"auto": "best", "auto-own": "own", "estimate": "best", "own": "own", "colmap": "colmap"}
"""Values of --poses that estimate a path; `still` and files do not."""
ONLY_IF_MOVING = ("auto", "auto-own")  # those that do so only where the camera moves
WITHOUT_COLMAP = {"auto": "auto-own", "estimate": "own", "colmap": "own"}
"""The same by our own tracks alone, which is ten times faster."""


@dataclass(frozen=True)
class Reading:
    """How the matrices of a file of poses are to be read."""

    convention: Convention = "opencv"
    unit_mm: float = 1.0  # mm per unit of the positions
    turn: NDArray[np.float64] | None = None
    """(3, 3) rotation from the camera that the poses belong to, to that of the frames; None if they are the same."""
    sources: Sequence[int] | None = None
    """Position in the video of each frame, from 0, where a file may have a row for each image of a video."""
    image_names: Sequence[str] = ()
    """Of all images of the folder that the frames come from, without suffixes, where a file names images."""

    @property
    def notes(self) -> list[str]:
        """A line for the user if the poses are turned."""
        angle = 0.0 if self.turn is None else float(np.degrees(Rotation.from_matrix(self.turn).magnitude()))
        if angle < NEGLIGIBLE_DEGREES:
            return []
        what = "given poses are those of the left camera before rectification"
        return [f"{what}; they are turned as its images are, by {angle:.2f} degrees"]

    def ours(self, stored: NDArray[np.float64]) -> NDArray[np.float64]:
        """(T, 4, 4) camera-to-world of the frames, mm, OpenCV axes."""
        poses = to_ours(stored, self.convention, self.unit_mm)
        if self.turn is not None:
            poses[:, :3, :3] = poses[:, :3, :3] @ self.turn.T
        return poses


AS_OURS = Reading()


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
    reading: Reading = AS_OURS,
    progress: Callable[[int], None] = lambda done: None,
) -> tuple[CameraPath | None, list[str]]:
    """The path, None for a static camera; and notes for the user.

    Args:
        how: a name of `METHODS`, `still`, or a file of poses.
        frame: reads frame i.
        views: opens all images and all tissue masks, one after the other.
        lens: its focal length may be an assumption: `refine_focal`.
        size: (width, height), px.
        reading: how the matrices of a file are to be read, and what they belong to.
    Raises:
        InputError: the file of poses cannot be used, or COLMAP is asked for and not there.
    """
    if how not in (*METHODS, "still"):
        known, notes = np.ones(count, bool), list(reading.notes)
        if is_model(Path(how)):
            if reading.convention != AS_OURS.convention:
                want = f"no convention for {how}, whose axes are known"
                raise input_error("--poses-convention", want, "one", "Remove --poses-convention.")
            sources = range(count) if reading.sources is None else reading.sources
            stored, known, rule = read_model_poses(Path(how), sources, reading.image_names)
            notes.append(f"{how}: poses {rule}; their unit is that of --poses-unit-mm")
        else:
            stored = read_poses(Path(how), count, reading.sources)
        path = CameraPath(reading.ours(stored), known, np.ones(count))
        if has_depth:
            notes += _fit_notes(how, stored, frame, lens, reading)
        if has_depth and lens.depth_is_relative:  # its scale is that at which its points agree with the poses
            follower = follow_camera(frame, count, lens, progress)
            world = with_poses(follower, np.linalg.inv(path.camera_to_world), known)
            path = replace(path, depth_scale=world.scales)
        return path, notes
    if (reading.convention, reading.unit_mm) != (AS_OURS.convention, AS_OURS.unit_mm):
        got, fix = f"--poses {how}", "Remove --poses-convention and --poses-unit-mm."
        raise input_error("--poses-convention", "a file with --poses", got, fix)
    if how == "still":
        return None, []
    motion = camera_motion(*views())
    if how in ONLY_IF_MOVING and not motion.moving:
        return None, [f"the camera is static: {motion.reason}"]
    if not has_depth:
        return None, [f"the camera moves: {motion.reason}; without depth its path cannot be estimated"]
    path = find_path(frame, count, lens, size, METHODS[how], refine_focal=refine_focal, progress=progress)
    return path, [*_estimate_notes(motion.reason, path, lens), *path.notes]


def rescaled(stored: NDArray, scale: float) -> NDArray[np.uint16]:
    """Stored depth times a factor; 0, missing, stays, and what is too far for 16 bits becomes it."""
    units = np.round(stored.astype(np.float64) * scale)
    return np.where(units <= FARTHEST_UNIT, units, 0).astype(np.uint16)


def _fit_notes(how: str, stored: NDArray, frame: Callable[[int], PoseInput], lens: Lens, reading: Reading) -> list[str]:
    """A note if the images say that the poses are to be read in another way."""

    def view(index: int) -> View:
        seen = frame(index)
        return seen.rgb_u8, seen.tissue_mask, np.nan_to_num(seen.depth)

    scaled, turn = stored.copy(), np.eye(3) if reading.turn is None else reading.turn
    scaled[:, :3, 3] *= reading.unit_mm
    relative = lens.depth_is_relative
    fit = measure_poses(view, lens.matrix, scaled, reading.convention, turn=turn, relative=relative)
    if fit is not None and fit.another_fits:
        unit = f" --poses-unit-mm {fit.unit * reading.unit_mm:.4g}" if fit.unit * reading.unit_mm != 1 else ""
        words = f"the poses in {how} explain the images better in another way: {fit.reason}"
        return [f"{words}. If so: --poses-convention {fit.best}{unit}"]
    if fit is not None and fit.none_fits:
        return [f"the poses in {how} do not explain the images: {fit.reason}. Is each in the row of its frame?"]
    return []


def _estimate_notes(reason: str, path: CameraPath, lens: Lens) -> list[str]:
    """How far the path reaches and how sure it is, where the camera rests, and the focal length if it was refined."""
    unit, centers = length_unit(lens.depth_is_relative), path.camera_to_world[:, :3, 3]
    reach = np.linalg.norm(centers - centers[0], axis=1).max()
    notes = [f"the camera moves: {reason}; the estimated path reaches {reach:.0f} {unit} from its start"]
    if path.translation_std is not None and path.rotation_std is not None and np.isfinite(path.translation_std).any():
        moved, turned = np.nanmedian(path.translation_std), np.nanmedian(path.rotation_std)
        stds = f"{moved:.2f} {unit}, {turned:.3f} degrees"
        notes.append(f"camera pose, standard deviation (median of the frames): {stds}")
    if path.still is not None and path.still.any():
        notes.append(f"the camera rests in frames {number_ranges(np.flatnonzero(path.still).tolist())}")
    if path.focal_factor != 1:
        old = lens.matrix[0, 0]
        notes.append(f"focal length refined with the path: {old * path.focal_factor:.0f} px in place of {old:.0f} px")
    return notes
