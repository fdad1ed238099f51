"""Points and depth scales for poses that come from elsewhere: a file, or COLMAP."""

from __future__ import annotations

import copy

import numpy as np
from numpy.typing import NDArray

from .adjust import adjust
from .follow import Follower
from .residuals import back_projected
from .tracks import Tracks

PARALLAX = 0.02
"""Least spread of the rays to a point, rad, whose position counts for the scale."""
FEWEST = 10
"""With fewer such points in a frame, its scale is that of the frames around."""
STRIDE = 3
"""Points are placed by every third frame and all keyframes: neighbors add nothing."""


def with_poses(follower: Follower, poses: NDArray[np.float64], known: NDArray[np.bool_]) -> Follower:
    """A copy of the tracks whose points lie where these poses see them, with the depth scale of each frame.

    Args:
        poses: (T, 4, 4) world-to-camera.
        known: (T,) frames that have one.
    """
    out = copy.copy(follower)
    tracks = out.tracks = follower.tracks.copy()
    out.poses, out.scales = poses.copy(), np.ones(len(poses))
    position, spread = ray_points(tracks, poses, known)
    good = spread > PARALLAX
    scales = np.full(len(poses), np.nan)
    for f in np.flatnonzero(known):
        ids, depths = tracks.ids[f], tracks.depths[f]
        z = position[ids] @ poses[f][2, :3] + poses[f][2, 3]
        use = good[ids] & (depths > 0) & (z > 0)
        if use.sum() >= FEWEST:
            scales[f] = np.median(z[use] / depths[use])
    there = np.flatnonzero(np.isfinite(scales))
    if len(there):
        out.scales = np.exp(np.interp(np.arange(len(poses)), there, np.log(scales[there])))
    keys = {k.frame for k in follower.keyframes}
    frames = [int(f) for n, f in enumerate(np.flatnonzero(known)) if n % STRIDE == 0 or f in keys]
    for f in reversed(frames):  # the first sight of a point stays
        ids, pixels, z = tracks.ids[f], tracks.pixels[f].astype(np.float64), tracks.depths[f] * out.scales[f]
        tracks.points[ids] = back_projected(follower.lens.matrix, poses[f], pixels, z)
    tracks.points[: len(good)][good] = position[good]
    ids, seen = tracks.of_frames(frames, out.scales)
    if len(ids):
        fixed = np.ones(len(frames), bool)
        done = adjust(follower.lens.matrix, poses[frames], tracks.points[ids], seen, fixed, rounds=4, steps=2)
        tracks.points[ids], tracks.weight[ids], tracks.adjusted[ids] = done.points, done.track_weight, True
    return out


def ray_points(
    tracks: Tracks, poses: NDArray[np.float64], known: NDArray[np.bool_]
) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """(P, 3) point nearest to all rays of each track, and (P,) the spread of the rays, rad; 0 with less than two rays.

    The point minimizes sum |(I - d d^T) (X - c)|^2 over rays with center c and direction d.
    """
    matrix, right, number = np.zeros((tracks.count, 9)), np.zeros((tracks.count, 3)), np.zeros(tracks.count)
    inverse = np.linalg.inv(tracks.lens.matrix)
    for f in np.flatnonzero(known):
        ids = tracks.ids[f]
        rays = np.concatenate([tracks.pixels[f], np.ones((len(ids), 1))], 1) @ inverse.T @ poses[f][:3, :3]
        rays /= np.linalg.norm(rays, axis=1, keepdims=True)
        across = np.eye(3) - rays[:, :, None] * rays[:, None]
        center = -poses[f][:3, :3].T @ poses[f][:3, 3]
        np.add.at(matrix, ids, across.reshape(-1, 9))
        np.add.at(right, ids, across @ center)
        np.add.at(number, ids, 1)
    matrix = matrix.reshape(-1, 3, 3)
    several = number > 1
    points, spread = np.zeros((tracks.count, 3)), np.zeros(tracks.count)
    values = np.linalg.eigvalsh(matrix[several]) if several.any() else np.zeros((0, 3))
    spread[several] = np.sqrt(np.maximum(values[:, 0], 0) / number[several])
    solvable = spread > 1e-6
    points[solvable] = np.linalg.solve(matrix[solvable], right[solvable][:, :, None])[:, :, 0]
    return points, spread
