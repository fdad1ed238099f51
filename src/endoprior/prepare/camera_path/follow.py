"""Follow the camera through a clip: tracks from frame to frame, a pose each, keyframes, and the way back after a loss.

A loss starts a new segment with a world of its own. A segment whose keyframe is recognized in another one moves into
its world (relocalization), with the scale of its depth if that is relative. Only a few frames are in memory at a time.
"""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
from numpy.typing import NDArray

from ...core.ranges import evenly_spaced
from ...system.parallel import frame_threads
from .adjust import INLIER_PX, adjust, back_projected, coarse_pose
from .features import (
    Keyframe,
    KeyframeMatch,
    TrackingFrame,
    followed,
    followed_directly,
    keyframe,
    match_keyframe,
    new_corners,
    sampled,
    tracking_frame,
)
from .tracks import FrameReader, TrackingCamera, Tracks

BYTES_PER_PX = 60  # memory in which a thread prepares a frame, bytes for each px of a square one
MIN_TRACKS = 30  # with fewer tracks a frame gets no pose from the frame before
MIN_INLIERS = 0.4
"""Share of the tracks that one pose must explain; below, the frame shows another place or another scene."""
KEYFRAME_GAP = 10  # frames from one keyframe to the next at most: the weights need the history of a breath ...
KEYFRAME_LEFT = 0.7  # ... and earlier when less than this share of its tracks is left ...
KEYFRAME_SHIFT = 0.08  # ... or when they have moved by this share of the image width
WINDOW = 8  # keyframes that are adjusted together with each new one
RECENT, OLDER = 6, 14  # keyframes that a lost frame is compared with: the last ones, and others spread over the clip


class Follower:
    """What is known about the path so far."""

    def __init__(self, camera: TrackingCamera, count: int, *, few_corners: bool = False) -> None:
        """Args: count: frames of the sequence. few_corners: whether images are aligned directly first."""
        self.few_corners, self.camera, self.tracks = few_corners, camera, Tracks(camera)
        self.poses = np.tile(np.eye(4), (count, 1, 1))  # (T, 4, 4) world-to-camera, in the world of the frame's segment
        self.scales = np.ones(count)
        self.segment = np.full(count, -1)
        self.keyframes: list[Keyframe] = []
        self._ids, self._pixels = np.zeros(0, np.int32), np.zeros((0, 2), np.float32)
        self._view: TrackingFrame | None = None
        self._at_keyframe = self._ids, self._pixels

    def follow(self, index: int, view: TrackingFrame) -> None:
        """Add the next frame."""
        before, lost = self._view, True
        depths, follow = np.zeros(0, np.float32), followed_directly if self.few_corners else followed
        if before is not None and (found := follow(before, view, self._pixels)) is not None:
            kept, pixels = found
            measured = sampled(view.depth, pixels).astype(np.float32)
            lost = not self._find_pose(index, before, self._ids[kept], self._pixels[kept], pixels, measured)
            if not lost:
                self._ids, self._pixels, depths = self._ids[kept], pixels, measured
        if lost:
            self._start_segment(index)
        self._view = view
        self.tracks.see(index, self._ids, self._pixels, depths)
        if lost or self._keyframe_is_due(index):
            self._add_keyframe(index)
        self._refill(index, view)
        if self.keyframes[-1].frame == index:
            self._at_keyframe = self._ids, self._pixels

    def _find_pose(
        self, index: int, last_view: TrackingFrame, ids: NDArray, before: NDArray, pixels: NDArray, depths: NDArray
    ) -> bool:
        """Set pose and scale of a frame from its tracks; False if nothing rigid explains them."""
        tracks, camera = self.tracks, self.camera
        if len(ids) < MIN_TRACKS:
            return False
        used = ~tracks.held_out(ids)
        trusted = used & (tracks.weight[ids] > 0.1)
        used = trusted if trusted.sum() >= MIN_TRACKS else used
        ids, before, pixels, depths = ids[used], before[used], pixels[used], depths[used]
        last, limit = self.poses[index - 1], INLIER_PX * camera.px
        found = coarse_pose(camera.matrix, tracks.points[ids], pixels, last, limit)
        if found is not None and found[1].mean() >= MIN_INLIERS:
            fine = tracks.refined(found[0], ids, tracks.points[ids], pixels, depths)
            pose, inlier = (fine.pose, fine.inlier) if fine.inlier.sum() >= 0.7 * found[1].sum() else found
        else:
            # Tissue that breathes leaves the place where it was first seen; from one frame to the next it moves little.
            z = sampled(last_view.depth, before) * self.scales[index - 1]
            there = z > 0
            points = back_projected(camera.matrix, last, before[there].astype(np.float64), z[there])
            found = coarse_pose(camera.matrix, points, pixels[there], last, limit)
            if found is None or found[1].mean() < MIN_INLIERS:
                return False
            pose, inlier = found[0], np.zeros(len(ids), bool)
            inlier[np.flatnonzero(there)[found[1]]] = True
        self.poses[index], self.segment[index] = pose, self.segment[index - 1]
        self.scales[index] = self._scale(pose, ids[inlier], depths[inlier], self.scales[index - 1])
        return True

    def set_scale(self, frame: int, usable: NDArray[np.bool_]) -> None:
        """Set the factor of a frame's depth by its rigid points, of those that are usable (P,)."""
        ids = self.tracks.ids[frame]
        good = usable[ids] & (self.tracks.weight[ids] > 0.3)
        depths = self.tracks.depths[frame][good]
        self.scales[frame] = self._scale(self.poses[frame], ids[good], depths, self.scales[frame])

    def _scale(self, pose: NDArray, ids: NDArray, depths: NDArray, otherwise: float) -> float:
        """Median ratio of the points' z to the measured depth; 1 where depth has a unit."""
        if not self.camera.depth_is_relative:
            return 1.0
        z = self.tracks.points[ids] @ pose[2, :3] + pose[2, 3]
        good = (depths > 0) & (z > 0)
        return float(np.median(z[good] / depths[good])) if good.sum() >= 5 else float(otherwise)

    def _start_segment(self, index: int) -> None:
        """Forget the tracks; the frame before becomes a keyframe, so that this one can be recognized by it."""
        if index and (not self.keyframes or self.keyframes[-1].frame != index - 1):
            self._add_keyframe(index - 1)
        elif index and (self.segment == self.segment[index - 1]).sum() == 1:
            self.keyframes.pop()  # a single frame that nothing recognizes
        self._ids, self._pixels = np.zeros(0, np.int32), np.zeros((0, 2), np.float32)
        self.poses[index], self.scales[index], self.segment[index] = np.eye(4), 1.0, index

    def _keyframe_is_due(self, index: int) -> bool:
        ids, pixels = self._at_keyframe
        kept, now, then = np.intersect1d(self._ids, ids, return_indices=True)
        if index - self.keyframes[-1].frame >= KEYFRAME_GAP or len(kept) < KEYFRAME_LEFT * len(ids):
            return True
        shift = np.hypot(*(self._pixels[now] - pixels[then]).T)
        return bool(np.median(shift) > KEYFRAME_SHIFT * 640 * self.camera.px)

    def _add_keyframe(self, index: int) -> None:
        """Describe the frame in `self._view`, link its segment if it stands alone, adjust the last keyframes."""
        assert self._view is not None
        new = keyframe(index, self._view)
        others = [old for old in self.keyframes if self.segment[old.frame] != self.segment[index]]
        self.keyframes.append(new)
        tried = [*others[-RECENT:], *(others[i] for i in evenly_spaced(max(len(others) - RECENT, 0), OLDER))]
        links = [
            (match_keyframe(self.camera, old, self.poses[old.frame], self.scales[old.frame], new), old) for old in tried
        ]
        if found := [(each, old) for each, old in links if each is not None]:
            best, old = max(found, key=lambda pair: len(pair[0].old))
            self._move_segment(index, best, int(self.segment[old.frame]))
        self._adjust_last()

    def _move_segment(self, index: int, found: KeyframeMatch, target: int) -> None:
        """Move the segment of a frame into the world in which the frame has the pose of the match."""
        frames = np.flatnonzero(self.segment == self.segment[index])
        factor = found.scale / self.scales[index] if self.camera.depth_is_relative else 1.0
        back, old = np.linalg.inv(found.pose), self.poses[index].copy()
        ids = np.unique(np.concatenate([self.tracks.ids[f] for f in frames if f < len(self.tracks.ids)] or [self._ids]))
        points = (self.tracks.points[ids] @ old[:3, :3].T + old[:3, 3]) * factor
        self.tracks.points[ids] = points @ back[:3, :3].T + back[:3, 3]
        inverse = np.linalg.inv(old)
        for frame in frames:
            between = self.poses[frame] @ inverse
            between[:3, 3] *= factor
            self.poses[frame] = between @ found.pose
        self.scales[frames] *= factor
        self.segment[frames] = target

    def _adjust_last(self) -> None:
        """Adjust the last keyframes of the segment and their points; the oldest of them hold the world."""
        segment, tracks = self.segment[self.keyframes[-1].frame], self.tracks
        frames = [k.frame for k in self.keyframes if self.segment[k.frame] == segment][-WINDOW:]
        if len(frames) < 3:
            return
        ids, seen = tracks.of_frames(frames, self.scales)
        if len(ids) < MIN_TRACKS:
            return
        fixed = np.arange(len(frames)) < (2 if len(frames) > 3 else 1)
        done = adjust(self.camera.matrix, self.poses[frames], tracks.points[ids], seen, fixed, rounds=2, steps=1)
        if not np.isfinite(done.poses).all():
            return
        self.poses[frames], tracks.points[ids], tracks.weight[ids] = done.poses, done.points, done.track_weight
        for frame in frames:
            self.set_scale(frame, np.ones(len(tracks.weight), bool))

    def _refill(self, index: int, view: TrackingFrame) -> None:
        """Detect new corners where tracks died; their points come from depth."""
        pixels = new_corners(view, self._pixels)
        depths = sampled(view.depth, pixels).astype(np.float32)
        z = depths.astype(np.float64) * self.scales[index]
        points = back_projected(self.camera.matrix, self.poses[index], pixels.astype(np.float64), z)
        ids = self.tracks.add_points(points, keypoint=False)
        self.tracks.see(index, ids, pixels, depths)
        self._ids, self._pixels = np.concatenate([self._ids, ids]), np.concatenate([self._pixels, pixels])


def follow_camera(
    frames: FrameReader,
    camera: TrackingCamera,
    progress: Callable[[int], None] = lambda _done: None,
    *,
    few_corners: bool = False,
) -> Follower:
    """Follow the camera through all frames, each read once, in order."""
    follower = Follower(camera, frames.count, few_corners=few_corners)

    def view(index: int) -> TrackingFrame:
        return tracking_frame(frames.frame(index), coarse=few_corners)

    with frame_threads(BYTES_PER_PX * camera.size[0] ** 2) as pool:
        for index, seen in enumerate(pool.map(view, range(frames.count))):
            follower.follow(index, seen)
            progress(index + 1)
    return follower
