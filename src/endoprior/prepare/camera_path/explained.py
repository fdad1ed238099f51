"""How well a path explains the frames: the reprojection error of tracks that took no part in any estimate.

Each of these tracks is triangulated from every second of its observations, and compared with the others. A frame
without a pose scores 0, so a path gains nothing by dropping hard frames.
"""

from __future__ import annotations

import numpy as np

from .adjust import Observations, adjust
from .residuals import back_projected, residuals
from .seen import CameraPath, Lens
from .tracks import DEPTH_STD, Tracks

USUAL_PX = 1.0
"""An error of this many px, at a width of 640, scores one half: 1 / (1 + e^2)."""


def explained_share(tracks: Tracks, lens: Lens, path: CameraPath) -> float:
    """Mean over all frames of the mean score of their held-out observations, 0..1.

    Args:
        tracks: their points are not used.
        lens: before any refinement of the focal length.
        path: what is measured.
    """
    lens = lens.with_focal(path.focal_factor)
    poses = np.linalg.inv(path.camera_to_world)
    parts: list[list[np.ndarray]] = [[], [], [], []]
    turn = np.zeros(tracks.count, int)
    for f in range(len(poses)):
        mine = tracks.held_out(tracks.ids[f])
        ids = tracks.ids[f][mine]
        columns = ids, np.full(len(ids), f), tracks.pixels[f][mine], tracks.depths[f][mine]
        for part, column in zip(parts, columns, strict=True):
            part.append(column)
    ids, frame, pixels, depths = (np.concatenate(part) for part in parts)
    order = np.argsort(ids, kind="stable")  # by track, in time
    ids, frame, pixels, depths = ids[order], frame[order], pixels[order].astype(np.float64), depths[order]
    first = np.searchsorted(ids, ids)
    turn = np.arange(len(ids)) - first
    fitted = (turn % 2 == 0) & path.explained[frame]
    inverse = 1 / np.where(depths > 0, depths * path.depth_scale[frame], 1.0)
    number = np.bincount(ids[fitted], minlength=tracks.count)
    std = np.where(
        depths > 0, DEPTH_STD[lens.depth_is_relative] * inverse * np.sqrt(np.maximum(number[ids], 1)), np.inf
    )
    sigma = np.stack([np.full(len(ids), USUAL_PX * lens.px), std], 1)
    points = np.zeros((tracks.count, 3))
    at = np.flatnonzero(fitted)[::-1]
    for f in np.unique(frame[at]):
        here = at[frame[at] == f]
        points[ids[here]] = back_projected(lens.matrix, poses[f], pixels[here], 1 / inverse[here])
    seen = Observations(frame[fitted], ids[fitted], pixels[fitted], inverse[fitted], sigma[fitted])
    done = adjust(lens.matrix, poses, points, seen, np.ones(len(poses), bool), rounds=3, steps=3, widest=8.0)
    tested = (turn % 2 == 1) & (number[ids] > 0)
    error = residuals(lens.matrix, poses[frame], done.points[ids], pixels, inverse, sigma)
    score = np.where(path.explained[frame], 1 / (1 + (error[:, :2] ** 2).sum(1)), 0.0)[tested]
    total = np.bincount(frame[tested], weights=score, minlength=len(poses))
    count = np.bincount(frame[tested], minlength=len(poses))
    rated = (count > 0) | ~path.explained
    return float((total[rated] / np.maximum(count[rated], 1)).mean()) if rated.any() else 0.0
