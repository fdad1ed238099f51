"""Scores that need ground truth: what the tool hid, and where material points really went.

Tracks may be known in all frames, as on a phantom; or points are known in the first and, others, in the last frame, as
in STIR, which does not say which became which.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from ..core.types import Camera
from ..data import FrameSequence, nearest_end_errors
from ..model.carry import carry_points
from ..model.scene import Scene
from . import metrics


@dataclass(frozen=True)
class Followed:
    """`P` material points over `T` frames, as the scene carries them and as they went; camera axes, mm."""

    predicted: NDArray[np.floating]
    """(T, P, 3)."""
    truth: NDArray[np.floating]
    """(T, P, 3)."""
    visible: NDArray[np.bool_]
    """(T, P) True where the point is seen and counts: not in the frame it starts in."""
    first: NDArray[np.intp]
    """(P,) frame each point starts in."""
    camera: Camera


def follow_tracks(scene: Scene, sequence: FrameSequence) -> Followed | None:
    """Carry every true point that two frames show, from the first that shows it; None without such points."""
    tracks = sequence.truth and sequence.truth.tracks
    if not tracks or not tracks.paired:
        return None
    followed = tracks.visible.sum(0) > 1
    if not followed.any():
        return None
    points, visible = tracks.points[:, followed].astype(np.float64), tracks.visible[:, followed].copy()
    first = visible.argmax(0)
    columns = np.arange(points.shape[1])
    cameras = scene.cameras
    to_world = np.stack([np.linalg.inv(camera.world_to_camera) for camera in cameras])
    start = np.einsum("pij,pj->pi", to_world[first][:, :3, :3], points[first, columns]) + to_world[first][:, :3, 3]
    carried = carry_points(scene, start, first, [i / len(cameras) for i in range(len(cameras))])
    predicted = np.stack(
        [
            p @ camera.world_to_camera[:3, :3].T + camera.world_to_camera[:3, 3]
            for p, camera in zip(carried, cameras, strict=True)
        ]
    )
    visible[first, columns] = False
    return Followed(predicted, points, visible, first, cameras[0])


def track_end_error_mm(scene: Scene, sequence: FrameSequence) -> float:
    """Mean distance of points carried from the first to the last frame to the nearest true point there, mm.

    The error of STIR's benchmark, for tracks that are not paired; NaN if no point is known at start or end.
    """
    tracks = sequence.truth and sequence.truth.tracks
    if not tracks or tracks.paired or not (tracks.visible[0].any() and tracks.visible[-1].any()):
        return math.nan
    first, last = scene.cameras[0], scene.cameras[-1]
    start = _to_world(tracks.points[0, tracks.visible[0]].astype(np.float64), first)
    ends = _to_world(tracks.points[-1, tracks.visible[-1]].astype(np.float64), last)
    moment = (len(scene.cameras) - 1) / len(scene.cameras)
    carried = carry_points(scene, start, np.zeros(len(start), np.intp), [0.0, moment])
    return float(nearest_end_errors(carried[1], ends).mean())


def _to_world(points: NDArray[np.float64], camera: Camera) -> NDArray[np.float64]:
    """(P, 3) points in camera axes, in world axes."""
    to_world = np.linalg.inv(camera.world_to_camera)
    return points @ to_world[:3, :3].T + to_world[:3, 3]


def track_scores(scene: Scene, sequence: FrameSequence) -> dict[str, float]:
    """`track_error_mm`, `track_error_px`, `track_fold_rate`, `track_tear_rate`; NaN if nothing can be followed."""
    found = follow_tracks(scene, sequence)
    if found is None:
        names = ("track_error_mm", "track_error_px", "track_fold_rate", "track_tear_rate")
        return dict.fromkeys(names, math.nan)
    error = metrics.track_error(found.predicted, found.truth, found.visible, found.camera)
    rates = metrics.neighbor_breaks(found.predicted, found.truth, found.visible, found.first)
    return {
        "track_error_mm": error.mm,
        "track_error_px": error.px,
        "track_fold_rate": rates.fold,
        "track_tear_rate": rates.tear,
    }
