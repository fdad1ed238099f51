"""Errors of predicted tracks of material points. Shared letters: `T` frames, `P` points."""

from __future__ import annotations

from dataclasses import replace
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray
from scipy.spatial import cKDTree

from ...core.checks import check_shape
from ...core.geometry import project
from ...core.types import Camera

NEIGHBORS = 4
"""Nearest neighbors of each point whose connection is checked."""
TEAR_STRETCH = 2.0
"""A connection between neighbors that is this many times too long is torn."""


class TrackError(NamedTuple):
    """Mean error of predicted points; NaN where it is undefined."""

    mm: float
    """Mean 3D distance, mm."""
    px: float
    """Mean distance in the image, px."""


def track_error(predicted: NDArray, truth: NDArray, visible: NDArray[np.bool_], camera: Camera) -> TrackError:
    """Mean distance between predicted and true points over every visible (frame, point), in space and in the image.

    Args:
        predicted: (T, P, 3) predicted positions in camera axes, mm.
        truth: (T, P, 3) true positions in camera axes, mm, z > 0 where visible.
        visible: (T, P) True where the true point is visible and its error counts.
        camera: intrinsics; its pose is ignored, because the points are in camera axes.
    Returns:
        Both means. NaN when nothing is visible; `px` is NaN also when a predicted point that counts lies at z <= 0,
        where it has no image. Ignoring such points would reward losing them.
    Raises:
        ValueError: shapes differ, `visible` is not bool, a point that counts is not finite, or a true one has z <= 0.
    """
    check_shape("predicted:T,P,3 truth:T,P,3 visible:T,P", predicted=predicted, truth=truth, visible=visible)
    if visible.dtype != np.bool_:
        raise ValueError(f"visible must be bool; got {visible.dtype}")
    got, want = predicted[visible].astype(np.float64), truth[visible].astype(np.float64)
    if not (np.isfinite(got).all() and np.isfinite(want).all()):
        raise ValueError("predicted and truth must be finite where visible; got NaN or infinity")
    if len(want) == 0:
        return TrackError(float("nan"), float("nan"))
    in_camera_axes = replace(camera, world_to_camera=np.eye(4))
    (got_px, got_z), (want_px, want_z) = project(got, in_camera_axes), project(want, in_camera_axes)
    if not (want_z > 0).all():
        raise ValueError(f"truth must have z > 0 where visible; got a smallest z of {want_z.min():g} mm")
    mm = float(np.linalg.norm(got - want, axis=-1).mean())
    px = float(np.linalg.norm(got_px - want_px, axis=-1).mean()) if (got_z > 0).all() else float("nan")
    return TrackError(mm, px)


class NeighborBreaks(NamedTuple):
    """How often neighboring points fold over or separate; NaN without any pair."""

    fold: float
    """Share of (frame, pair) in which the predicted connection of two neighbors points against the true one."""
    tear: float
    """Share of (frame, pair) in which it is more than `TEAR_STRETCH` times as long as the true one."""


def neighbor_breaks(
    predicted: NDArray, truth: NDArray, visible: NDArray[np.bool_], first: NDArray[np.integer]
) -> NeighborBreaks:
    """Folds and tears between each point and its nearest neighbors that start in the same frame.

    Args:
        predicted, truth: (T, P, 3) positions, mm. visible: (T, P) True where a point counts.
        first: (P,) frame each point starts in; `truth` is known there.
    Returns:
        Both shares over all frames in which both ends of a pair count.
    """
    check_shape(
        "predicted:T,P,3 truth:T,P,3 visible:T,P first:P",
        predicted=predicted,
        truth=truth,
        visible=visible,
        first=first,
    )
    folds = tears = total = 0
    for start in np.unique(first):
        group = np.flatnonzero(first == start)
        k = min(NEIGHBORS + 1, len(group))
        _, nearest = cKDTree(truth[start, group]).query(truth[start, group], k=k)
        a, b = np.repeat(group, k), group[np.reshape(nearest, -1)]
        a, b = np.unique(np.sort(np.stack([a, b]), 0)[:, a != b], axis=1)  # each pair once
        both = visible[:, a] & visible[:, b]
        wanted, got = (truth[:, a] - truth[:, b])[both], (predicted[:, a] - predicted[:, b])[both]
        folds += int(((wanted * got).sum(-1) < 0).sum())
        tears += int((np.linalg.norm(got, axis=-1) > TEAR_STRETCH * np.linalg.norm(wanted, axis=-1)).sum())
        total += len(wanted)
    return NeighborBreaks(folds / total, tears / total) if total else NeighborBreaks(float("nan"), float("nan"))
