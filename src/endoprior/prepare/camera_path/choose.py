"""The camera path of a clip: by our own tracks, or by COLMAP where it is installed and explains the frames better."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from typing import Literal

import numpy as np

from ...core.checks import input_error
from ...core.shell import install_command
from .adjust import Observations, adjust, back_projected, residuals
from .colmap import LONGEST, colmap_path, is_installed
from .own import own_path
from .tracks import DEPTH_STD, CameraPath, Lens, PoseInput, Tracks

How = Literal["best", "own", "colmap"]
USUAL_PX = 1.0  # an error of this many px, at a width of 640, scores one half: 1 / (1 + e^2)


def find_path(
    frame: Callable[[int], PoseInput],
    count: int,
    lens: Lens,
    size: tuple[int, int],
    how: How = "best",
    *,
    refine_focal: bool = False,
    progress: Callable[[int], None] = lambda done: None,
) -> CameraPath:
    """Estimate the camera path.

    Args:
        frame: reads frame i.
        size: (width, height), px.
        how: `best` takes what explains the frames better.
        refine_focal: the focal length is an assumption.
        progress: is told the number of frames followed.
    Raises:
        InputError: `colmap` without its package, or without a result.
    """
    if how == "colmap" and not is_installed():
        raise input_error("--poses colmap", "the package pycolmap", "none", f"`{install_command('poses')}`.")
    own, follower = own_path(frame, count, lens, size, refine_focal=refine_focal, progress=progress)
    if how == "own" or not is_installed():
        return own
    if how == "best" and (own.breathes or count > LONGEST):  # COLMAP would give breathing to the camera
        return own
    other = colmap_path(frame, count, follower, refine_focal=refine_focal)
    if other is None:
        if how == "colmap":
            raise input_error("--poses colmap", "images that COLMAP can register", "too few", "Use `--poses own`.")
        return replace(own, notes=[*own.notes, "COLMAP registers too few frames; the path is our own"])
    other = replace(other, focal_factor=own.focal_factor * other.focal_factor)
    mine, theirs = (explained_share(follower.tracks, lens, path) for path in (own, other))
    best = other if how == "colmap" or theirs > mine else own
    note = f"camera path by {best.method}: COLMAP explains {theirs:.1%} of the held-out tracks, our own path {mine:.1%}"
    return replace(best, notes=[*own.notes, note, *other.notes] if best is own else [*best.notes, note])


def explained_share(tracks: Tracks, lens: Lens, path: CameraPath) -> float:
    """Mean over all frames of the mean score of their held-out observations, 0..1: tracks of no estimate.

    Each of these tracks is triangulated from every second of its observations, and compared with the others. A frame
    without a pose scores 0, so a path gains nothing by dropping hard frames.

    Args:
        tracks: their points are not used.
        lens: before any refinement of the focal length.
        path: what is measured.
    """
    lens = lens.with_focal(path.focal_factor)
    poses = np.linalg.inv(path.camera_to_world)
    frame = np.repeat(np.arange(len(poses)), [len(each) for each in tracks.ids])
    ids, pixels, depths = (np.concatenate(each) for each in (tracks.ids, tracks.pixels, tracks.depths))
    order = np.argsort(ids, kind="stable")  # by track, in time
    order = order[tracks.held_out(ids[order])]
    ids, frame, pixels, depths = ids[order], frame[order], pixels[order].astype(np.float64), depths[order]
    turn = np.arange(len(ids)) - np.searchsorted(ids, ids)
    fitted = (turn % 2 == 0) & path.explained[frame]
    inverse = 1 / np.where(depths > 0, depths * path.depth_scale[frame], 1.0)
    number = np.bincount(ids[fitted], minlength=tracks.count)
    std = DEPTH_STD[lens.depth_is_relative] * inverse * np.sqrt(np.maximum(number[ids], 1))
    std = np.where(depths > 0, std, np.inf)
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
