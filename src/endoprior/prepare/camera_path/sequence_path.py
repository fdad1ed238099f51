"""The camera path of written frames, as `prepare` and `poses` want it: static, estimated, or from a file.

It is estimated by our own tracks, or by COLMAP where that is installed and explains the frames better.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Literal

import numpy as np
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from ...core.checks import frame_list, input_error
from ...core.geometry import Convention, length_unit, to_ours
from ...core.ranges import evenly_spaced
from ...core.shell import install_command
from ...data.writer import FARTHEST_UNIT
from ...footage.camera_motion import SHOWN, CameraMotion
from ...footage.known_facts import KnownFacts
from ...footage.pose_fit import RgbdFrame, measure_poses
from ...system.parallel import frame_threads
from .adjust import Observations, adjust, back_projected, residuals
from .colmap import LONGEST, colmap_path, is_installed, with_poses
from .follow import Follower, follow_camera
from .own import own_path
from .path import CameraPath, path_motion
from .pose_file import MM_PER_M, is_model, is_text, read_model_poses, read_poses, read_text_poses
from .refine import refined_path
from .shape import DepthShape, axial_cosine, fitted_shape, shape_by_light
from .tracks import DEPTH_STD, FrameReader, TrackingCamera, Tracks

BYTES_PER_PX = 60  # memory in which a thread compares two frames, bytes for each px
USUAL_PX = 1.0  # an error of this many px, at a width of 640, scores one half: 1 / (1 + e^2)
NEGLIGIBLE_DEGREES = 1e-3
ASSUMED, CALIBRATED = "assumed field of view", "calibration"  # origins of the focal length: `sources.lens`
How = Literal["best", "own", "colmap"]
METHODS: dict[str, How] = {"auto": "best", "auto-own": "own", "estimate": "best", "own": "own", "colmap": "colmap"}
"""Values of --poses that estimate a path; `still` and files do not."""
ONLY_IF_MOVING = ("auto", "auto-own")  # those that do so only where the camera moves
WITHOUT_COLMAP = {"auto": "auto-own", "estimate": "own", "colmap": "own"}  # the same, ten times faster
MIN_POSED = 8  # frames; a shorter path is none
SHAPINGS = 2
"""Where the camera drives ahead, triangulated points or the light of a tube fix the shape of relative depth, and the
camera is followed again so often with the better depth."""
DRIVES = "forward", "backward", "translating"  # kinds of motion in which a tube is looked for
LIT_FRAMES = 16  # number of frames that are asked for a tube
UNKNOWN_POSES = "none: the motion of the camera is unknown"  # `sources.poses`
STILL_EXPLAINED = 0.95  # share of the score of held-out tracks that a refined path keeps: tracks drift, it does not
FIT = "path and lens are adjusted to direct matches of frames with parallax, which they fit"
UNFIT = "direct matches of frames with parallax fit no camera"


@dataclass(frozen=True)
class Reading:
    """How the matrices of a file of poses are to be read."""

    convention: Convention = "opencv"
    unit_mm: float | None = None  # mm per unit of the positions; None: as usual for files of the kind
    turn: NDArray | None = None  # (3, 3) rotation from the camera of the poses to that of the frames; None: the same
    sources: Sequence[int] | None = None  # place of each frame in the video, where a file has a row for each image
    image_times: Sequence[float] = ()  # of all images of the video, or else of the frames, s
    image_names: Sequence[str] = ()  # of all images of the folder of the frames, where a file names images

    @property
    def notes(self) -> list[str]:
        """A line for the user if the poses are turned."""
        angle = 0.0 if self.turn is None else float(np.degrees(Rotation.from_matrix(self.turn).magnitude()))
        if angle < NEGLIGIBLE_DEGREES:
            return []
        what = "given poses are those of the left camera before rectification"
        return [f"{what}; they are turned as its images are, by {angle:.2f} degrees"]

    def ours(self, stored: NDArray) -> NDArray:
        """(T, 4, 4) camera-to-world of the frames, mm, OpenCV axes."""
        poses = to_ours(stored, self.convention, self.unit_mm or 1.0)
        if self.turn is not None:
            poses[:, :3, :3] = poses[:, :3, :3] @ self.turn.T
        return poses


AS_OURS = Reading()


def sequence_path(
    how: str,
    frames: FrameReader,
    camera: TrackingCamera,
    *,
    has_depth: bool = True,
    reading: Reading = AS_OURS,
    progress: Callable[[int], None] = lambda _done: None,
    facts: KnownFacts | None = None,
) -> tuple[CameraPath | None, list[str]]:
    """The path, None for a static camera; and notes for the user.

    Args:
        how: a name of `METHODS`, `still`, or a file of poses.
        has_depth: whether the frames have any.
        reading: how the matrices of a file are to be read, and what they belong to.
        progress: is told the number of frames followed.
        facts: gets the motion of the image as a whole.
    Raises:
        InputError: the file of poses cannot be used, or COLMAP is asked for and not there.
    """
    if how not in (*METHODS, "still"):
        return _given_path(how, frames, camera, has_depth, reading, progress)
    if (reading.convention, reading.unit_mm) != (AS_OURS.convention, AS_OURS.unit_mm):
        got, fix = f"--poses {how}", "Remove --poses-convention and --poses-unit-mm."
        raise input_error("--poses-convention", "a file with --poses", got, fix)
    if how == "still":
        return None, []
    facts, everything = facts or KnownFacts(), range(frames.count)
    with frame_threads(BYTES_PER_PX * camera.size[0] * camera.size[1]) as pool:
        motion = facts.camera_motion(
            lambda: map(frames.color, everything), lambda: map(frames.tissue, everything), pool.map
        )
    if how in ONLY_IF_MOVING and motion.kind == "static":
        return None, [motion.text]
    if not has_depth:
        return None, [f"{motion.text}; without depth its path cannot be estimated"]
    path = find_path(frames, camera, METHODS[how], few_corners=motion.few_corners, progress=progress)
    if how in ONLY_IF_MOVING and (why := _doubt(path, motion)):
        return _unknown_path(motion, why)
    return path, [*_estimate_notes(motion.reason, path, camera), *path.notes]


def _doubt(path: CameraPath, motion: CameraMotion) -> str:
    """Why the path is no answer; empty if it is one."""
    posed = int(path.explained.sum())
    if posed < max(MIN_POSED, min(motion.resting.sum(), len(path.explained))):
        return f"only {posed} of {len(path.explained)} frames can be linked by poses"
    if path.kind == "static" and posed < SHOWN * len(path.explained):
        return f"the path rests, but only {posed} of {len(path.explained)} frames are on it"
    if path.motion is not None and path.motion.contradicts(motion.pixels_per_frame):
        return "the estimated path moves otherwise than the images"
    return ""


def _unknown_path(motion: CameraMotion, why: str) -> tuple[CameraPath, list[str]]:
    """One camera for the longest stretch in which the view rests; all other frames are unexplained."""
    rests, count = motion.resting, len(motion.stretch)
    if rests.sum() < min(MIN_POSED, max(2, count / 2)):  # most of a short clip are enough
        rests = np.zeros(count, bool)
    poses = np.tile(np.eye(4), (count, 1, 1))
    path = CameraPath(poses, rests, np.ones(count), UNKNOWN_POSES, is_unknown=True)
    frames = frame_list(np.flatnonzero(rests).tolist())
    end = f"in {frames} the view rests, and one camera serves them" if rests.any() else "no model is possible"
    moved = "how the camera moves is unknown" if motion.moving else "the motion of the camera is unknown"
    return path, [
        f"{moved}: {motion.reason}; {why}. No poses are claimed: {end}. More frames per second, or another part of "
        "the video, may say more"
    ]


def _given_path(
    how: str,
    frames: FrameReader,
    camera: TrackingCamera,
    has_depth: bool,
    reading: Reading,
    progress: Callable[[int], None],
) -> tuple[CameraPath, list[str]]:
    count = frames.count
    known, notes = np.ones(count, bool), list(reading.notes)
    if is_model(Path(how)):
        if reading.convention != AS_OURS.convention:
            want = f"no convention for {how}, whose axes are known"
            raise input_error("--poses-convention", want, "one", "Remove --poses-convention.")
        sources = range(count) if reading.sources is None else reading.sources
        stored, known, rule = read_model_poses(Path(how), sources, reading.image_names)
        notes.append(f"{how}: poses {rule}; their unit is that of --poses-unit-mm")
    elif is_text(Path(how)):
        unit_mm = reading.unit_mm or MM_PER_M
        reading = replace(reading, unit_mm=unit_mm)
        stored, rule = read_text_poses(Path(how), count, reading.sources, reading.image_times, unit_mm)
        notes.append(f"{how}: rows are matched {rule}; its unit is taken as {unit_mm:g} mm")
    else:
        stored = read_poses(Path(how), count)
    path = CameraPath(reading.ours(stored), known, np.ones(count))
    if has_depth:
        notes += _fit_notes(how, stored, frames, camera, reading)
    if has_depth and camera.depth_is_relative:  # its scale is that at which its points agree with the poses
        follower = follow_camera(frames, camera, progress)
        world = with_poses(follower, np.linalg.inv(path.camera_to_world), known)
        path = replace(path, depth_scale=world.scales)
    return path, notes


def find_path(
    frames: FrameReader,
    camera: TrackingCamera,
    how: How = "best",
    *,
    few_corners: bool = False,
    progress: Callable[[int], None] = lambda _done: None,
) -> CameraPath:
    """Estimate the camera path.

    Args:
        how: `best` takes what explains the frames better.
        few_corners: the images show so few corners that they are aligned as a whole first.
        progress: is told the number of frames followed.
    Raises:
        InputError: `colmap` without its package, or without a result.
    """
    if how == "colmap" and not is_installed():
        raise input_error("--poses colmap", "the package pycolmap", "none", f"`{install_command('poses')}`.")

    def followed(shape: DepthShape | None = None) -> tuple[CameraPath, Follower]:
        shaped = frames
        if shape is not None:
            shaped = replace(frames, depth=lambda i: shape.powered(frames.depth(i)))
        path, follower = own_path(shaped, camera, progress, few_corners=few_corners)
        return replace(path, motion=path_motion(path, follower.tracks, camera), shape=shape), follower

    own, follower = followed()
    if camera.depth_is_relative and own.motion and how != "colmap" and own.motion.kind in DRIVES:
        own, follower = _deeper(own, follower, followed, frames, axial_cosine(camera.with_focal(own.focal_factor)))
    if camera.depth_is_relative and how != "colmap":
        own = _refined(own, follower.tracks, frames, camera)
    if how == "own" or not is_installed():
        return own
    if how == "best" and (own.breathes or own.shape or frames.count > LONGEST):
        return own  # COLMAP would give breathing to the camera
    other = colmap_path(frames, follower)
    if other is None:
        if how == "colmap":
            raise input_error("--poses colmap", "images that COLMAP can register", "too few", "Use `--poses own`.")
        return replace(own, notes=[*own.notes, "COLMAP registers too few frames; the path is our own"])
    other = replace(other, focal_factor=own.focal_factor * other.focal_factor)
    other = replace(other, motion=path_motion(other, follower.tracks, camera))
    mine, theirs = (explained_share(follower.tracks, camera, path) for path in (own, other))
    best = other if how == "colmap" or theirs > mine else own
    note = f"camera path by {best.method}: COLMAP explains {theirs:.1%} of the held-out tracks, our own path {mine:.1%}"
    return replace(best, notes=[*own.notes, note, *other.notes] if best is own else [*best.notes, note])


def _deeper(
    path: CameraPath,
    follower: Follower,
    followed: Callable[[DepthShape | None], tuple[CameraPath, Follower]],
    frames: FrameReader,
    cosine: NDArray[np.float32],
) -> tuple[CameraPath, Follower]:
    """The path and its tracks with relative depth in the shape of triangulated points, else of the light in a tube; as
    they are if neither gives one, or if fewer frames follow by light.
    """
    shape = fitted_shape(path.explained, follower, cosine) if path.motion and path.motion.drives else None
    if shape is None:
        posed = np.flatnonzero(path.explained)
        shape = shape_by_light((frames.frame(int(posed[i])) for i in evenly_spaced(len(posed), LIT_FRAMES)), cosine)
    if shape is None:
        return path, follower
    new, tracks = path, follower
    for _ in range(SHAPINGS):
        new, tracks = followed(shape)
        shape = fitted_shape(new.explained, tracks, cosine, shape) or shape
    if not shape.pixels and new.explained.sum() < path.explained.sum():
        return path, follower
    return replace(new, shape=shape), tracks


def _refined(path: CameraPath, tracks: Tracks, frames: FrameReader, camera: TrackingCamera) -> CameraPath:
    """The path adjusted to direct matches if they fit and still explain the held-out tracks; else as it is."""

    def depth(index: int) -> NDArray[np.float32]:
        """In the shape and the scale of the path."""
        given = frames.depth(index)
        shaped = given if path.shape is None else path.shape.shaped(index, given)
        return (shaped * path.depth_scale[index]).astype(np.float32)

    found = refined_path(path, replace(frames, depth=depth), camera)
    if found is None:
        return path
    if not found.fits:
        note = f"{UNFIT} (residual {found.residual_px:.1f} px of 640): the tissue moves by itself"
        return replace(path, notes=[*path.notes, note])
    if explained_share(tracks, camera, found.path) < STILL_EXPLAINED * explained_share(tracks, camera, path):
        return path
    motion = path_motion(found.path, tracks, camera)
    note = f"{FIT} (residual {found.residual_px:.2f} px of 640)"
    return replace(found.path, motion=motion, notes=[*path.notes, note])


def explained_share(tracks: Tracks, camera: TrackingCamera, path: CameraPath) -> float:
    """Mean over all frames of the mean score of their held-out observations, 0..1: tracks of no estimate.

    Each of these tracks is triangulated from every second of its observations, and compared with the others. A frame
    without a pose scores 0, so a path gains nothing by dropping hard frames.

    Args:
        tracks: their points are not used.
        camera: before any refinement of the focal length.
    """
    camera, poses = camera.with_focal(path.focal_factor), np.linalg.inv(path.camera_to_world)
    frame = np.repeat(np.arange(len(poses)), [len(each) for each in tracks.ids])
    ids = np.concatenate(tracks.ids)
    order = np.argsort(ids, kind="stable")  # by track, in time
    order = order[tracks.held_out(ids[order])]
    ids, frame = ids[order], frame[order]
    pixels, depths = np.concatenate(tracks.pixels)[order].astype(np.float64), np.concatenate(tracks.depths)[order]
    turn = np.arange(len(ids)) - np.searchsorted(ids, ids)
    fitted = (turn % 2 == 0) & path.explained[frame]
    inverse = 1 / np.where(depths > 0, depths * path.depth_scale[frame], 1.0)
    number = np.bincount(ids[fitted], minlength=tracks.count)
    std = DEPTH_STD[camera.depth_is_relative] * inverse * np.sqrt(np.maximum(number[ids], 1))
    std = np.where(depths > 0, std, np.inf)
    sigma = np.stack([np.full(len(ids), USUAL_PX * camera.px), std], 1)
    points = np.zeros((tracks.count, 3))
    at = np.flatnonzero(fitted)[::-1]
    for f in np.unique(frame[at]):
        here = at[frame[at] == f]
        points[ids[here]] = back_projected(camera.matrix, poses[f], pixels[here], 1 / inverse[here])
    seen = Observations(frame[fitted], ids[fitted], pixels[fitted], inverse[fitted], sigma[fitted])
    done = adjust(camera.matrix, poses, points, seen, np.ones(len(poses), bool), rounds=3, steps=3, widest=8.0)
    tested = (turn % 2 == 1) & (number[ids] > 0)
    error = residuals(camera.matrix, poses[frame], done.points[ids], pixels, inverse, sigma)
    score = np.where(path.explained[frame], 1 / (1 + (error[:, :2] ** 2).sum(1)), 0.0)[tested]
    total = np.bincount(frame[tested], weights=score, minlength=len(poses))
    count = np.bincount(frame[tested], minlength=len(poses))
    rated = (count > 0) | ~path.explained
    return float((total[rated] / np.maximum(count[rated], 1)).mean()) if rated.any() else 0.0


def path_depth(path: CameraPath, index: int, stored: NDArray, unit_mm: float) -> NDArray[np.uint16]:
    """Stored relative depth (H, W) of a frame in the shape and the scale of the path."""
    if path.shape is not None:
        stored = path.shape.shaped(index, stored.astype(np.float32) * unit_mm) / unit_mm
    return rescaled(stored, float(path.depth_scale[index]))


def rescaled(stored: NDArray, scale: float) -> NDArray[np.uint16]:
    """Stored depth times a factor; 0, missing, stays, and what is too far for 16 bits becomes it."""
    units = np.round(stored.astype(np.float64) * scale)
    return np.where(units <= FARTHEST_UNIT, units, 0).astype(np.uint16)


def _fit_notes(how: str, stored: NDArray, frames: FrameReader, camera: TrackingCamera, reading: Reading) -> list[str]:
    """A note if the images say that the poses are to be read in another way."""

    def view(index: int) -> RgbdFrame:
        return frames.color(index), frames.tissue(index), np.nan_to_num(frames.depth(index))

    scaled, turn = stored.copy(), np.eye(3) if reading.turn is None else reading.turn
    unit_mm = reading.unit_mm or 1.0
    scaled[:, :3, 3] *= unit_mm
    fit = measure_poses(view, camera.matrix, scaled, reading.convention, turn=turn, relative=camera.depth_is_relative)
    if fit is not None and fit.another_fits:
        right = f"{fit.unit * unit_mm:.4g}"
        unit = f" --poses-unit-mm {right}" if right != "1" or is_text(Path(how)) else ""
        words = f"the poses in {how} explain the images better in another way: {fit.reason}"
        return [f"{words}. If so: --poses-convention {fit.best}{unit}"]
    if fit is not None and fit.none_fits:
        return [f"the poses in {how} do not explain the images: {fit.reason}. Is each in the row of its frame?"]
    return []


def _estimate_notes(reason: str, path: CameraPath, camera: TrackingCamera) -> list[str]:
    """How far the path reaches and how sure it is, where the camera rests, and the focal length if it was refined."""
    unit, centers = length_unit(camera.depth_is_relative), path.camera_to_world[:, :3, 3]
    reach = np.linalg.norm(centers - centers[0], axis=1).max()
    moves = "the camera hardly moves" if path.kind == "static" else "the camera moves"
    how = f"; by the path, its shift is {path.motion.reason}" if path.motion and len(path.motion.parts_px) else ""
    notes = [f"{moves}: {reason}{how}; the estimated path reaches {reach:.0f} {unit} from its start"]
    if path.shape is not None:
        by = "triangulated points" if path.shape.pixels else "brightness around a dark place, as in a tube"
        notes.append(f"the way ahead fixes the shape of relative depth: d^{path.shape.power:.1f}, and {by}")
    if path.translation_std is not None and path.rotation_std is not None and np.isfinite(path.translation_std).any():
        moved, turned = np.nanmedian(path.translation_std), np.nanmedian(path.rotation_std)
        stds = f"{moved:.2f} {unit}, {turned:.3f} degrees"
        notes.append(f"camera pose, standard deviation (median of the frames): {stds}")
    if path.still is not None and path.still.any():
        notes.append(f"the camera rests in {frame_list(np.flatnonzero(path.still).tolist())}")
    if path.focal_factor != 1:
        old = camera.matrix[0, 0]
        notes.append(f"focal length refined with the path: {old * path.focal_factor:.0f} px in place of {old:.0f} px")
    return notes
