"""Whether material points go where the scene carries them; needs ground truth.

The true tracks either cover all frames, as on a phantom, or are two sets of unpaired points, those of the first frame
and those of the last, as in STIR, which does not say which point became which.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from ...core.types import Camera
from ...data import FrameSequence, nearest_end_errors
from ...model.carry import carry_points
from ...model.scene import Scene
from .. import metrics
from ..context import EvaluationContext
from ..score import Score

SCORES = (
    Score(
        "track_end_error_mm", "track end error", "mm", False, 3,
        "Mean distance of points carried to the last frame to the nearest true one there, as in STIR's benchmark.",
        group="motion", hint="0 follows the tissue",
    ),
    Score(
        "track_error_mm", "track error", "mm", False, 3,
        "Mean distance between carried and true points over all frames in which the point is visible.",
        group="motion", hint="0 follows the tissue",
    ),
    Score(
        "track_error_px", "track error", "px", False, 3,
        "The same distance in the image.",
        group="motion", in_summary=False,
    ),
    Score(
        "track_fold_rate", "folds", "", False, 4,
        "Share of lines between a point and its nearest neighbors that point against the true line.",
        "absolute", group="motion", hint="0: neighbors keep their order",
    ),
    Score(
        "track_tear_rate", "tears", "", False, 4,
        "Share of such lines that are more than twice as long as the true line.",
        "absolute", group="motion", hint="0: neighbors stay together",
    ),
)  # fmt: skip


def compute(context: EvaluationContext) -> None:
    """Score paired tracks, or the end points of unpaired ones; nothing without ground truth."""
    sequence = context.sequence
    if sequence.truth is None:
        return
    scene = context.scene
    if sequence.truth.tracks and not sequence.truth.tracks.paired:
        context.add("track_end_error_mm", track_end_error_mm(scene, sequence), "no point has depth at start and end")
    for name, value in track_scores(scene, sequence).items():
        context.add(name, value, "no track is visible in two frames")


@dataclass(frozen=True)
class CarriedTracks:
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


def carry_tracks(scene: Scene, sequence: FrameSequence) -> CarriedTracks | None:
    """Carry every true point that is visible in two frames, from the first of them; None without such points."""
    tracks = sequence.truth and sequence.truth.tracks
    if not tracks or not tracks.paired:
        return None
    visible_twice = tracks.visible.sum(0) > 1
    if not visible_twice.any():
        return None
    points, visible = tracks.points[:, visible_twice].astype(np.float64), tracks.visible[:, visible_twice].copy()
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
    return CarriedTracks(predicted, points, visible, first, cameras[0])


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
    last_time = (len(scene.cameras) - 1) / len(scene.cameras)
    carried = carry_points(scene, start, np.zeros(len(start), np.intp), [0.0, last_time])
    return float(nearest_end_errors(carried[1], ends).mean())


def _to_world(points: NDArray[np.float64], camera: Camera) -> NDArray[np.float64]:
    """(P, 3) points in camera axes, in world axes."""
    to_world = np.linalg.inv(camera.world_to_camera)
    return points @ to_world[:3, :3].T + to_world[:3, 3]


def track_scores(scene: Scene, sequence: FrameSequence) -> dict[str, float]:
    """`track_error_mm`, `track_error_px`, `track_fold_rate`, `track_tear_rate`; NaN if no point can be carried."""
    carried = carry_tracks(scene, sequence)
    if carried is None:
        names = ("track_error_mm", "track_error_px", "track_fold_rate", "track_tear_rate")
        return dict.fromkeys(names, math.nan)
    error = metrics.track_error(carried.predicted, carried.truth, carried.visible, carried.camera)
    rates = metrics.neighbor_breaks(carried.predicted, carried.truth, carried.visible, carried.first)
    return {
        "track_error_mm": error.mm,
        "track_error_px": error.px,
        "track_fold_rate": rates.fold,
        "track_tear_rate": rates.tear,
    }
