"""Whether material points go where the scene carries them; needs ground truth.

The true tracks either cover all frames, as on a phantom, or are two sets of unpaired points, those of the first frame
and those of the last, as in STIR, which does not say which point became which. Scores of paired tracks stand beside
the same scores of chained optical flow and of no motion. `T` frames, `P` points.

Delta_avg: Schmidt et al., "Point Tracking in Surgery: the 2024 Surgical Tattoos in Infrared (STIR) Challenge".
Average Jaccard and occlusion accuracy: Doersch et al., "TAP-Vid: A Benchmark for Tracking Any Point in a Video".
"""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping
from dataclasses import replace

import cv2
import numpy as np
from numpy.typing import NDArray
from scipy.spatial import cKDTree

from ...core.geometry import camera_to_world, cells_at
from ...core.types import Frame
from ...data import FrameSequence, nearest_end_errors
from ...model.carry import carry_points
from ...model.scene import Scene
from ..context import EvaluationContext
from ..predicted_tracks import PredictedTracks, TrueTracks, by_chained_flow, by_scene, true_tracks, without_motion
from ..score import Score

NEAR_TOOL_PX = 40
"""Points within this distance of the tool mask are near the tool; px of an image 640 px wide."""
THRESHOLDS_PX = (4, 8, 16, 32, 64)
"""Distances within which a point counts as followed, px of the frame: those of STIR 2024."""
NEIGHBORS = 4
"""Nearest neighbors of each point whose connection is checked."""
TEAR_STRETCH = 2.0
"""A connection between neighbors that is this many times too long is torn."""
END_ERROR = Score(
    "track_end_error_mm", "track end error", "mm", False, 3,
    "Mean distance of points carried to the last frame to the nearest true one there, as in STIR's benchmark.",
    group="motion", hint="0 follows the tissue",
)  # fmt: skip
ACCURACY = (
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
        "track_error_median_px", "track error, median", "px", False, 3,
        "Median of that distance.",
        group="motion", in_summary=False,
    ),
    Score(
        "track_error_p90_px", "track error, 90 %", "px", False, 3,
        "90th percentile of that distance.",
        group="motion", in_summary=False,
    ),
    Score(
        "track_error_after_hidden_mm", "seen again", "mm", False, 3,
        "Track error where the point is visible again after at least one frame that hides it.",
        group="motion", hint="tissue that was hidden before",
    ),
    Score(
        "track_error_near_tool_mm", "track near tool", "mm", False, 3,
        "Track error within 40 px of the tool mask, in px of an image 640 px wide.",
        group="motion", in_summary=False,
    ),
    Score(
        "track_error_pulled_mm", "track, pulled", "mm", False, 3,
        "Track error of points that move by at least half of a pull; phantoms with regions only.",
        group="motion", in_summary=False,
    ),
    Score(
        "track_error_smooth_mm", "track, smooth", "mm", False, 3,
        "Track error of other points on tissue with little texture; phantoms with regions only.",
        group="motion", in_summary=False,
    ),
    Score(
        "track_delta_avg", "delta_avg", "", True, 3,
        "Share of visible points within 4, 8, 16, 32 and 64 px of the truth, mean of the five, as in STIR 2024.",
        "absolute", group="motion", hint="1 follows the tissue",
    ),
    Score(
        "track_average_jaccard", "average Jaccard", "", True, 3,
        "TP / (TP + FP + FN) of position and visibility at these distances, mean of the five, as in TAP-Vid.",
        "absolute", group="motion", hint="1: position and visibility right",
    ),
    Score(
        "track_occlusion_accuracy", "occlusion accuracy", "", True, 3,
        "Share of points whose visibility is predicted right, as in TAP-Vid.",
        "absolute", group="motion", hint="1: visibility right",
    ),
)  # fmt: skip
"""Scores that any prediction of tracks has."""
BREAKS = (
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
REFERENCES = {"dis": "chained optical flow (DIS)", "still": "no motion"}
"""What stands beside the scene's scores, by the end of the name."""
SCORES = (
    END_ERROR,
    *ACCURACY,
    *BREAKS,
    *(
        replace(
            score,
            name=f"{score.name}_{end}",
            label=f"{score.label}, {'flow' if end == 'dis' else 'no motion'}",
            description=f"`{score.name}` of {what}.",
            in_summary=False,
            hint="",
        )
        for score in ACCURACY
        for end, what in REFERENCES.items()
    ),
)
WHY_NOT = {
    "track_error_after_hidden_mm": "no point is hidden and seen again",
    "track_error_near_tool_mm": "no visible point is near a tool",
    "track_error_pulled_mm": "the truth has no such region",
    "track_error_smooth_mm": "the truth has no such region",
}
NO_TRACKS = "no track is visible in two frames"
NO_PAIRS = "no two neighbors are visible together"
BEHIND = "a point is predicted behind the camera"


def compute(context: EvaluationContext) -> None:
    """Score paired tracks, or the end points of unpaired ones; nothing without ground truth."""
    sequence = context.sequence
    if sequence.truth is None:
        return
    scene = context.scene
    if sequence.truth.tracks and not sequence.truth.tracks.paired:
        context.add("track_end_error_mm", track_end_error_mm(scene, sequence), "no point has depth at start and end")
    true = true_tracks(sequence)
    if true is None:
        for score in (*ACCURACY, *BREAKS):
            context.skip(score.name, NO_TRACKS)
        return
    parts = parts_of(true, sequence)
    predictions: dict[str, Callable[[], PredictedTracks]] = {
        "": lambda: by_scene(scene, true, sequence),
        "_dis": lambda: by_chained_flow(true, sequence),
        "_still": lambda: without_motion(true, sequence),
    }
    for end, predict in predictions.items():
        with context.skip_if_unavailable(*(score.name + end for score in ACCURACY)):
            predicted = predict()
            for name, value in track_scores(predicted, true, parts).items():
                context.add(name + end, value, WHY_NOT.get(name, BEHIND))
            if not end:
                rates = neighbor_breaks(predicted.points, true.points, true.visible & true.counted, true.first)
                for score, rate in zip(BREAKS, rates, strict=True):
                    context.add(score.name, rate, NO_PAIRS)


def track_scores(
    predicted: PredictedTracks, true: TrueTracks, parts: Mapping[str, NDArray[np.bool_]]
) -> dict[str, float]:
    """Every score of `ACCURACY` by name; NaN where nothing counts, infinite for predictions without an image.

    Args:
        parts: by `parts_of`.
    """
    visible = true.visible & true.counted
    # A hidden truth may lie behind the camera: its distance does not count.
    distance_px = np.linalg.norm(predicted.pixels - np.where(np.isfinite(true.pixels), true.pixels, 0), axis=-1)
    distance_mm = np.linalg.norm(predicted.points.astype(np.float64) - true.points, axis=-1)
    return {
        "track_error_mm": _mean(distance_mm[visible]),
        "track_error_px": _mean(distance_px[visible]),
        "track_error_median_px": _quantile(distance_px[visible], 0.5),
        "track_error_p90_px": _quantile(distance_px[visible], 0.9),
        **{f"track_error_{part}_mm": _mean(distance_mm[visible & chosen]) for part, chosen in parts.items()},
        **track_accuracy(distance_px, predicted.visible, true.visible, true.counted),
    }


def track_accuracy(
    distance_px: NDArray[np.floating],
    predicted_visible: NDArray[np.bool_],
    visible: NDArray[np.bool_],
    counted: NDArray[np.bool_],
) -> dict[str, float]:
    """Shares in [0, 1] by the name of the score, over every (frame, point) that counts; NaN where nothing does.

    A point is a true positive if it is visible, predicted visible and near; a false positive if it is predicted
    visible, but is hidden or far; a false negative if it is visible, but predicted hidden or far.

    Args:
        distance_px: (T, P) distance of predicted and true pixel; infinite where a prediction has no image. Where the
            truth is hidden, it does not matter.
        predicted_visible, visible: (T, P) prediction and truth.
        counted: (T, P) True where a point counts: after the frame it starts in.
    """
    visible, predicted_visible = visible & counted, predicted_visible & counted
    if not visible.any():
        return dict.fromkeys(("track_delta_avg", "track_average_jaccard", "track_occlusion_accuracy"), math.nan)
    deltas, jaccards = [], []
    for threshold in THRESHOLDS_PX:
        near = visible & (distance_px <= threshold)
        found = near & predicted_visible
        wrong, missed = predicted_visible & ~found, visible & ~found
        deltas.append(near.sum() / visible.sum())
        jaccards.append(found.sum() / (found.sum() + wrong.sum() + missed.sum()))
    return {
        "track_delta_avg": float(np.mean(deltas)),
        "track_average_jaccard": float(np.mean(jaccards)),
        "track_occlusion_accuracy": float((visible == predicted_visible)[counted].mean()),
    }


def neighbor_breaks(
    predicted: NDArray, truth: NDArray, visible: NDArray[np.bool_], first: NDArray[np.integer]
) -> tuple[float, float]:
    """Folds and tears between each point and its nearest neighbors that start in the same frame.

    Args:
        predicted, truth: (T, P, 3) positions, mm. visible: (T, P) True where a point counts.
        first: (P,) frame each point starts in; `truth` is known there.
    Returns:
        Share of (frame, pair), both ends of which count, in which the predicted connection points against the true one;
        and in which it is more than `TEAR_STRETCH` times as long. NaN without any pair.
    """
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
    return (folds / total, tears / total) if total else (math.nan, math.nan)


def parts_of(true: TrueTracks, sequence: FrameSequence) -> dict[str, NDArray[np.bool_]]:
    """(T, P) points that the error of each part is over."""
    nowhere = np.zeros(true.visible.shape[1], "U1")
    region = nowhere if true.region is None else true.region
    regions = {name: np.broadcast_to(region == name, true.visible.shape) for name in ("pulled", "smooth")}
    return {"after_hidden": seen_again(true), "near_tool": near_tool(true, sequence), **regions}


def seen_again(true: TrueTracks) -> NDArray[np.bool_]:
    """(T, P) where a point is visible, and was hidden in a frame since the one it starts in."""
    hidden_before = np.logical_or.accumulate(true.counted & ~true.visible, axis=0)
    return true.visible & hidden_before


def near_tool(true: TrueTracks, sequence: FrameSequence) -> NDArray[np.bool_]:
    """(T, P) where a visible point lies within `NEAR_TOOL_PX` of the tool mask."""
    near = np.zeros_like(true.visible)
    for i, frame in enumerate(sequence.frames("video")):
        if not frame.tissue_mask.all():
            columns, rows = cells_at(true.pixels[i, true.visible[i]], frame.camera.width, frame.camera.height)
            near[i, true.visible[i]] = _near_tool(frame)[rows, columns]
    return near


def _near_tool(frame: Frame) -> NDArray[np.bool_]:
    """(H, W) pixels within `NEAR_TOOL_PX` of the tool mask, which is not empty."""
    distance = cv2.distanceTransform(frame.tissue_mask.astype(np.uint8), cv2.DIST_L2, cv2.DIST_MASK_PRECISE)
    return distance <= NEAR_TOOL_PX * frame.camera.width / 640


def _mean(values: NDArray[np.floating]) -> float:
    return float(values.mean()) if len(values) else math.nan


def _quantile(values: NDArray[np.floating], share: float) -> float:
    """Linear between values as `np.quantile`, but infinite where one of the two is; NaN without values."""
    if not len(values):
        return math.nan
    with np.errstate(invalid="ignore"):
        found = float(np.quantile(values, share))
    return math.inf if math.isnan(found) else found


def track_end_error_mm(scene: Scene, sequence: FrameSequence) -> float:
    """Mean distance of points carried from the first to the last frame to the nearest true point there, mm.

    The error of STIR's benchmark, for tracks that are not paired; NaN if no point is known at start or end.
    """
    tracks = sequence.truth and sequence.truth.tracks
    if not tracks or tracks.paired or not (tracks.visible[0].any() and tracks.visible[-1].any()):
        return math.nan
    start, ends = (
        tracks.points[i, tracks.visible[i]].astype(np.float64) @ to_world[:3, :3].T + to_world[:3, 3]
        for i, to_world in zip((0, -1), camera_to_world([scene.cameras[0], scene.cameras[-1]]), strict=True)
    )
    last_time = (len(scene.cameras) - 1) / len(scene.cameras)
    carried = carry_points(scene, start, np.zeros(len(start), np.intp), [0.0, last_time])
    return float(nearest_end_errors(carried[1], ends).mean())
