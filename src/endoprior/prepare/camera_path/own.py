"""Our own path: follow the camera, close loops, adjust all keyframes, then place the frames between them.

Keyframes that show the same place at different times share points, so that the path cannot drift. Where the camera
rests, its pose is copied exactly, so that no jitter of the estimate reaches the scene.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from ...data.description import OWN_POSES
from .adjust import adjust, back_projected
from .breathing import Breathing, separate_breathing
from .features import Keyframe, match_keyframe
from .follow import Follower, follow_camera
from .path import CameraPath
from .tracks import FrameReader, TrackingCamera, Tracks

FOCAL_PRIOR = 0.2  # standard deviation of log f where the focal length is assumed
FOCAL_STD = 0.03  # a refined focal length is kept if the standard deviation of its logarithm is below this
BREATHES, NOT_CAMERA = "the tissue breathes", "what the view does in this rhythm is not counted as camera motion"
MIN_POINTS = 20  # with fewer adjusted points a frame keeps its pose relative to its keyframe
OVERLAP = 0.3  # least share of an old keyframe's points that lies in the new image
SHARED = 0.3  # keyframes that share more of their tracks than this need no loop
PARTNERS = 3  # old keyframes that each new one is matched with at most
LOW_PX, HIGH_PX = 0.25, 0.5
"""The camera rests while rigid tissue stays this near to where it was, px of an image 640 px wide; once at rest, it
moves when it is beyond the second value (hysteresis)."""
MIN_REST_FRAMES = 8  # a shorter rest is none: slow motion looks the same
RIGID = 0.5  # weight of a track that counts as rigid tissue
MIN_TRACKS = 20


def own_path(
    frames: FrameReader,
    camera: TrackingCamera,
    progress: Callable[[int], None] = lambda _done: None,
    *,
    few_corners: bool = False,
) -> tuple[CameraPath, Follower]:
    """The path, and the tracks it comes from. Each frame is read once, in order. Args: as `find_path`."""
    follower = follow_camera(frames, camera, progress, few_corners=few_corners)
    labels, counts = np.unique(follower.segment, return_counts=True)
    explained = follower.segment == labels[np.argmax(counts)]
    keyframes = sorted((k for k in follower.keyframes if explained[k.frame]), key=lambda k: k.frame)
    followed_poses, focal_factor = follower.poses.copy(), 1.0
    if len(keyframes) > 1:
        close_loops(follower, keyframes)
        focal_factor = _adjust_all(follower, keyframes)
    starts, breathing = np.array([k.frame for k in keyframes], int), None
    if not camera.depth_is_relative and len(keyframes) > 1 and explained[starts[0] : starts[-1] + 1].all():
        place_frames(follower, starts, followed_poses, explained)
        breathing = separate_breathing(follower, starts.tolist())
    stds = place_frames(follower, starts, followed_poses, explained, breathing)
    path = finished_path(follower, explained, *stds)
    notes = [] if breathing is None else [f"{BREATHES} every {breathing.period:.1f} frames; {NOT_CAMERA}"]
    return replace(path, focal_factor=focal_factor, breathes=breathing is not None, notes=notes), follower


def _adjust_all(follower: Follower, keyframes: list[Keyframe]) -> float:
    """Adjust all keyframes at once; returns the refined focal length as a multiple of the given one."""
    tracks, frames = follower.tracks, [k.frame for k in keyframes]
    fixed, factor, refine_focal = np.arange(len(frames)) == 0, 1.0, follower.camera.focal_is_assumed
    for turn in range(4 if refine_focal else 3):
        ids, seen = tracks.of_frames(frames, follower.scales)
        if not len(ids):
            return factor
        prior, (rounds, widest) = FOCAL_PRIOR if refine_focal and turn else 0.0, (3, 1.0) if turn else (5, 16.0)
        done = adjust(
            follower.camera.matrix, follower.poses[frames], tracks.points[ids], seen, fixed,
            rounds=rounds, steps=2, focal_prior=prior, widest=widest,
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
            follower.camera = tracks.camera = follower.camera.with_focal(done.focal_factor)
        for f in frames:
            follower.set_scale(f, tracks.adjusted)
    return factor


def place_frames(
    follower: Follower, starts: NDArray, followed: NDArray, explained: NDArray, breathing: Breathing | None = None
) -> tuple[NDArray, NDArray]:
    """Set the pose of every frame from the adjusted points; standard deviations of translation, mm, and rotation, rad.

    Args:
        starts: frames whose pose stays.
        followed: (T, 4, 4) poses before the adjustment: they say how a frame lies to its keyframe.
    """
    tracks = follower.tracks
    stds = np.full((2, len(explained)), np.nan)
    for f in np.flatnonzero(explained).tolist() if len(starts) else ():
        at = starts[max(np.searchsorted(starts, f, "right") - 1, 0)]
        if f not in starts:
            follower.poses[f] = followed[f] @ np.linalg.inv(followed[at]) @ follower.poses[at]
        ids, pixels, depths = tracks.ids[f], tracks.pixels[f], tracks.depths[f]
        used = tracks.adjusted[ids] & ~tracks.held_out(ids)
        if used.sum() < MIN_POINTS:
            continue
        ids, pixels, depths = ids[used], pixels[used].astype(np.float64), depths[used]
        points = tracks.points[ids] if breathing is None else tracks.points[ids] + breathing.at(f, ids)
        found = tracks.refined(follower.poses[f], ids, points, pixels, depths)
        if not np.isfinite(found.pose).all():
            continue
        stds[:, f] = found.translation_std, found.rotation_std
        if f not in starts:
            follower.poses[f] = found.pose
            follower.set_scale(f, tracks.adjusted)
    return stds[0], stds[1]


def finished_path(
    follower: Follower, explained: NDArray, translation_std: NDArray, rotation_std: NDArray
) -> CameraPath:
    """The path with rests copied, gaps filled, and the first explained frame at the origin."""
    poses, scales, count = np.linalg.inv(follower.poses), follower.scales.copy(), len(explained)
    spans, still = resting(follower.tracks, explained), np.zeros(count, bool)
    for first, last in spans:
        poses[first : last + 1] = poses[(first + last) // 2]
        still[first : last + 1] = True
    seen = np.flatnonzero(explained)
    # Frames before the first explained one have its pose, later ones that of the frame before.
    source = seen[np.maximum(np.searchsorted(seen, np.arange(count), "right") - 1, 0)]
    poses, scales = poses[source], scales[source]
    factor = 1 / np.exp(np.median(np.log(scales))) if follower.camera.depth_is_relative else 1.0
    poses = np.linalg.inv(poses[0]) @ poses
    poses[:, :3, 3] *= factor
    if len(spans) == 1 and spans[0] == (0, count - 1):
        poses = np.tile(np.eye(4), (count, 1, 1))
    stds = translation_std * factor, np.degrees(rotation_std)
    return CameraPath(poses, explained, scales * factor, OWN_POSES, 1.0, *stds, still)


def close_loops(follower: Follower, keyframes: list[Keyframe]) -> None:
    """Match keyframes of one world with older ones of the same place; matched keypoints become tracks."""
    tracks, camera, poses, scales = follower.tracks, follower.camera, follower.poses, follower.scales
    points = [
        back_projected(camera.matrix, poses[k.frame], k.pixels.astype(np.float64), k.depths * scales[k.frame])
        for k in keyframes
    ]
    ids = [tracks.ids[k.frame] for k in keyframes]
    for b, new in enumerate(keyframes):
        overlap = np.array([_share_inside(camera, poses[new.frame], points[a]) for a in range(b)])
        partners: list[int] = []
        for a in np.argsort(-overlap, kind="stable"):
            if len(partners) == PARTNERS or overlap[a] < OVERLAP:
                break
            shared = len(np.intersect1d(ids[a], ids[b])) / max(min(len(ids[a]), len(ids[b])), 1)
            if shared < SHARED and all(abs(a - other) > 2 for other in partners):
                partners.append(int(a))
        for a in partners:
            old = keyframes[a]
            match = match_keyframe(camera, old, poses[old.frame], scales[old.frame], new)
            if match is None:
                continue
            fresh = old.track[match.old] < 0
            old.track[match.old[fresh]] = tracks.add_points(points[a][match.old[fresh]], keypoint=True)
            unseen = new.track[match.new] < 0
            new.track[match.new[unseen]] = old.track[match.old[unseen]]
            for key, which in ((old, match.old[fresh]), (new, match.new[unseen])):
                tracks.see(key.frame, key.track[which], key.pixels[which], key.depths[which])


def _share_inside(camera: TrackingCamera, pose: NDArray, points: NDArray) -> float:
    """Share of points (N, 3) that lie in the image."""
    matrix, size = camera.matrix, camera.size
    seen = points @ pose[:3, :3].T + pose[:3, 3]
    z = np.maximum(seen[:, 2], 1e-6)
    u, v = matrix[0, 0] * seen[:, 0] / z + matrix[0, 2], matrix[1, 1] * seen[:, 1] / z + matrix[1, 2]
    inside = (seen[:, 2] > 0) & (u >= 0) & (v >= 0) & (u < size[0]) & (v < size[1])
    return float(inside.mean()) if len(inside) else 0.0


def resting(tracks: Tracks, explained: NDArray[np.bool_]) -> list[tuple[int, int]]:
    """Spans (first, last) of frames in which the camera rests: the median rigid track stays where it was at first."""
    spans, first, count = [], 0, len(explained)
    while first < count - 1:
        if not explained[first]:
            first += 1
            continue
        last, limit = first, LOW_PX * tracks.camera.px
        while last + 1 < count and explained[last + 1] and _shift(tracks, first, last + 1) < limit:
            last += 1
            if last - first + 1 >= MIN_REST_FRAMES:
                limit = HIGH_PX * tracks.camera.px
        if last - first + 1 >= MIN_REST_FRAMES:
            spans.append((first, last))
            first = last
        first += 1
    return spans


def _shift(tracks: Tracks, first: int, other: int) -> float:
    """Median distance, px, of rigid tracks between two frames; inf if too few are seen in both."""
    shared, a, b = np.intersect1d(tracks.ids[first], tracks.ids[other], return_indices=True)
    rigid = (tracks.weight[shared] > RIGID) & ~tracks.keypoint[shared]
    if rigid.sum() < MIN_TRACKS:
        return np.inf
    moved = tracks.pixels[other][b[rigid]] - tracks.pixels[first][a[rigid]]
    return float(np.median(np.hypot(*moved.T)))
