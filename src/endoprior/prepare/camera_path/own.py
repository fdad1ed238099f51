"""Our own path: follow the camera, close loops, adjust all keyframes, then place the frames between them."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from ...data.description import OWN_POSES
from .adjust import adjust
from .breathing import Breathing, separate_breathing
from .follow import Follower, follow_camera
from .keyframes import Keyframe
from .loops import close_loops
from .resection import refined_pose
from .rest import resting
from .seen import CameraPath, Lens, PoseInput

FOCAL_PRIOR = 0.2
"""Standard deviation of log f where the focal length is assumed."""
FOCAL_STD = 0.03
"""A refined focal length is kept if the standard deviation of its logarithm is below this."""
BREATHES, NOT_CAMERA = "the tissue breathes", "what the view does in this rhythm is not counted as camera motion"
MIN_POINTS = 20
"""With fewer adjusted points a frame keeps its pose relative to its keyframe."""


def own_path(
    frame: Callable[[int], PoseInput],
    count: int,
    lens: Lens,
    size: tuple[int, int],
    *,
    refine_focal: bool = False,
    progress: Callable[[int], None] = lambda done: None,
) -> tuple[CameraPath, Follower]:
    """Estimate the camera pose of every frame.

    Args:
        frame: reads frame i; each is read once, in order.
        size: (width, height) of the images, px.
        refine_focal: the focal length is an assumption.
    Returns:
        The path, and the tracks it comes from.
    """
    follower = follow_camera(frame, count, lens, progress)
    labels, frames = np.unique(follower.segment, return_counts=True)
    explained = follower.segment == labels[np.argmax(frames)]
    keyframes = sorted((k for k in follower.keyframes if explained[k.frame]), key=lambda k: k.frame)
    followed_poses = follower.poses.copy()
    focal_factor = 1.0
    if len(keyframes) > 1:
        close_loops(follower, keyframes, size)
        focal_factor = _adjust_all(follower, keyframes, refine_focal)
    starts, breathing = np.array([k.frame for k in keyframes], int), None
    if not lens.depth_is_relative and len(keyframes) > 1 and explained[starts[0] : starts[-1] + 1].all():
        place_frames(follower, starts, followed_poses, explained)
        breathing = separate_breathing(follower, starts.tolist())
    stds = place_frames(follower, starts, followed_poses, explained, breathing)
    path = finished_path(follower, explained, *stds)
    notes = [] if breathing is None else [f"{BREATHES} every {breathing.period:.1f} frames; {NOT_CAMERA}"]
    return replace(path, focal_factor=focal_factor, breathes=breathing is not None, notes=notes), follower


def _adjust_all(follower: Follower, keyframes: list[Keyframe], refine_focal: bool) -> float:
    """Adjust all keyframes at once; returns the refined focal length as a multiple of the given one."""
    tracks, frames = follower.tracks, [k.frame for k in keyframes]
    fixed = np.arange(len(frames)) == 0
    factor = 1.0
    for turn in range(4 if refine_focal else 3):
        ids, seen = tracks.of_frames(frames, follower.scales)
        if not len(ids):
            return factor
        prior = FOCAL_PRIOR if refine_focal and turn else 0.0
        matrix = follower.lens.matrix
        first = turn == 0
        done = adjust(
            matrix, follower.poses[frames], tracks.points[ids], seen, fixed,
            rounds=5 if first else 3, steps=2, focal_prior=prior, widest=16.0 if first else 1.0,
        )  # fmt: skip
        if not np.isfinite(done.poses).all():
            return factor
        if prior and done.focal_std > FOCAL_STD:
            refine_focal = False  # the path does not determine it
            continue
        follower.poses[frames], tracks.points[ids], tracks.weight[ids] = done.poses, done.points, done.track_weight
        tracks.adjusted[ids] = True
        if prior:
            factor *= done.focal_factor
            follower.lens = tracks.lens = follower.lens.with_focal(done.focal_factor)
        for f in frames:
            follower.scales[f] = _frame_scale(follower, f)
    return factor


def _frame_scale(follower: Follower, frame: int) -> float:
    """Factor of the depth of a frame: median ratio of z of its adjusted rigid points to the depth."""
    if not follower.lens.depth_is_relative:
        return 1.0
    tracks, ids, depths = follower.tracks, follower.tracks.ids[frame], follower.tracks.depths[frame]
    pose = follower.poses[frame]
    z = tracks.points[ids] @ pose[2, :3] + pose[2, 3]
    good = tracks.adjusted[ids] & (tracks.weight[ids] > 0.3) & (depths > 0) & (z > 0)
    return float(np.median(z[good] / depths[good])) if good.sum() >= 5 else float(follower.scales[frame])


def place_frames(
    follower: Follower,
    starts: NDArray[np.intp],
    followed: NDArray[np.float64],
    explained: NDArray[np.bool_],
    breathing: Breathing | None = None,
) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Set the pose of every frame from the adjusted points; standard deviations of translation, mm, and rotation, rad.

    Args:
        starts: frames whose pose stays.
        followed: (T, 4, 4) poses before the adjustment: they say how a frame lies to its keyframe.
    """
    tracks, lens = follower.tracks, follower.lens
    stds = np.full((2, len(explained)), np.nan)
    for f in np.flatnonzero(explained) if len(starts) else ():
        at = starts[max(np.searchsorted(starts, f, "right") - 1, 0)]
        if f not in starts:
            follower.poses[f] = followed[f] @ np.linalg.inv(followed[at]) @ follower.poses[at]
        ids, pixels, depths = tracks.ids[f], tracks.pixels[f], tracks.depths[f]
        used = tracks.adjusted[ids] & ~tracks.held_out(ids)
        if used.sum() < MIN_POINTS:
            continue
        ids, pixels, depths = ids[used], pixels[used].astype(np.float64), depths[used]
        inverse, sigma = tracks.measured(ids, depths, 1.0)
        if lens.depth_is_relative:
            sigma[:, 1] = np.inf
        start, points = follower.poses[f], tracks.points[ids]
        if breathing is not None:
            points = points + breathing.at(int(f), ids)
        found = refined_pose(lens.matrix, start, points, pixels, inverse, sigma, tracks.weight[ids])
        if not np.isfinite(found.pose).all():
            continue
        stds[:, f] = found.translation_std, found.rotation_std
        if f not in starts:
            follower.poses[f] = found.pose
            follower.scales[f] = _frame_scale(follower, f)
    return stds[0], stds[1]


def finished_path(
    follower: Follower, explained: NDArray[np.bool_], translation_std: NDArray, rotation_std: NDArray
) -> CameraPath:
    """The path with rests copied, gaps filled, and the first explained frame at the origin."""
    poses, scales, count = np.linalg.inv(follower.poses), follower.scales.copy(), len(explained)
    spans = resting(follower.tracks, explained)
    still = np.zeros(count, bool)
    for first, last in spans:
        poses[first : last + 1] = poses[(first + last) // 2]
        still[first : last + 1] = True
    seen = np.flatnonzero(explained)
    # Frames before the first explained one have its pose, later ones that of the frame before.
    source = seen[np.maximum(np.searchsorted(seen, np.arange(count), "right") - 1, 0)]
    poses, scales = poses[source], scales[source]
    factor = 1 / np.exp(np.median(np.log(scales))) if follower.lens.depth_is_relative else 1.0
    poses = np.linalg.inv(poses[0]) @ poses
    poses[:, :3, 3] *= factor
    if len(spans) == 1 and spans[0] == (0, count - 1):
        poses = np.tile(np.eye(4), (count, 1, 1))
    return CameraPath(
        poses,
        explained,
        scales * factor,
        OWN_POSES,
        1.0,
        translation_std * factor,
        np.degrees(rotation_std),
        still,
    )
