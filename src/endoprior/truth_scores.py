"""Scores that need ground truth: what the tool hid, and where material points really went.

Tracks may be known in all frames, as on a phantom, or in two, as in STIR (start and end).
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from . import metrics
from .data import Sequence
from .model.carry import carry_points
from .model.scene import Scene
from .types import Camera


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


def follow_tracks(scene: Scene, sequence: Sequence) -> Followed | None:
    """Carry every true point that two frames show, from the first that shows it; None without such points."""
    tracks = sequence.truth and sequence.truth.tracks
    if not tracks:
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


def track_scores(scene: Scene, sequence: Sequence) -> dict[str, float]:
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
