"""Accuracy of predicted tracks in the image, as in the benchmarks of point tracking. `T` frames, `P` points.

Delta_avg: Schmidt et al., "Point Tracking in Surgery: the 2024 Surgical Tattoos in Infrared (STIR) Challenge".
Average Jaccard and occlusion accuracy: Doersch et al., "TAP-Vid: A Benchmark for Tracking Any Point in a Video".
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from ...core.checks import check_shape

THRESHOLDS_PX = (4, 8, 16, 32, 64)
"""Distances within which a point counts as followed, px of the frame: those of STIR 2024."""


class TrackAccuracy(NamedTuple):
    """Shares in [0, 1]; NaN where nothing counts."""

    delta_avg: float
    """Share of visible points that are near the truth, mean over the thresholds."""
    average_jaccard: float
    """Position and visibility together: TP / (TP + FP + FN), mean over the thresholds."""
    occlusion_accuracy: float
    """Share of points whose visibility is right."""


def track_accuracy(
    distance_px: NDArray[np.floating],
    predicted_visible: NDArray[np.bool_],
    visible: NDArray[np.bool_],
    counted: NDArray[np.bool_],
) -> TrackAccuracy:
    """Score every (frame, point) that counts.

    A point is a true positive if it is visible, predicted visible and near; a false positive if it is predicted
    visible, but is hidden or far; a false negative if it is visible, but predicted hidden or far.

    Args:
        distance_px: (T, P) distance of predicted and true pixel; infinite where a prediction has no image. Where the
            truth is hidden, it does not matter.
        predicted_visible, visible: (T, P) prediction and truth.
        counted: (T, P) True where a point counts: after the frame it starts in.
    """
    check_shape(
        "distance_px:T,P predicted_visible:T,P visible:T,P counted:T,P",
        distance_px=distance_px,
        predicted_visible=predicted_visible,
        visible=visible,
        counted=counted,
    )
    visible, predicted_visible = visible & counted, predicted_visible & counted
    if not visible.any():
        return TrackAccuracy(float("nan"), float("nan"), float("nan"))
    deltas, jaccards = [], []
    for threshold in THRESHOLDS_PX:
        near = visible & (distance_px <= threshold)
        found = near & predicted_visible
        wrong, missed = predicted_visible & ~found, visible & ~found
        deltas.append(near.sum() / visible.sum())
        jaccards.append(found.sum() / (found.sum() + wrong.sum() + missed.sum()))
    right = (visible == predicted_visible)[counted].mean()
    return TrackAccuracy(float(np.mean(deltas)), float(np.mean(jaccards)), float(right))
