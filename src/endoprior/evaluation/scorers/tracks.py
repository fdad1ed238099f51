"""Whether material points go where the scene carries them; needs ground truth.

The true tracks either cover all frames, as on a phantom, or are two sets of unpaired points, those of the first frame
and those of the last, as in STIR, which does not say which point became which. Scores of paired tracks stand beside
the same scores of chained optical flow and of no motion. `T` frames, `P` points, which are in camera axes of their
frame, mm; pixels in px of the frame.

Delta_avg: Schmidt et al., "Point Tracking in Surgery: the 2024 Surgical Tattoos in Infrared (STIR) Challenge".
Average Jaccard and occlusion accuracy: Doersch et al., "TAP-Vid: A Benchmark for Tracking Any Point in a Video".
"""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator, Mapping, Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray
from scipy.spatial import KDTree

from ...core.geometry import back_project, bilinear, camera_to_world, cells_at, project
from ...core.types import Camera, Frame, frame_times
from ...data import FrameSequence, nearest_end_errors
from ...footage.image_operations import Image, distance_inside
from ...footage.optical_flow import MIN_SIZE_PX, fine_flow, fine_shrink, gray_for_flow
from ...model.carry import carry_points
from ...model.scene import Scene
from ...model.surface import project_visible, render_surface, shown_pixels
from ...system.memory import workers
from ..context import EvaluationContext
from ..score import Score, ScoreUnavailable

NEAR_TOOL_PX = 40  # Points within this distance of the tool mask are near the tool; px of an image 640 px wide
THRESHOLDS_PX = (4, 8, 16, 32, 64)
"""Distances within which a point counts as followed, px of the frame: those of STIR 2024."""
NEIGHBORS = 4  # Nearest neighbors of each point whose connection is checked
TEAR_STRETCH = 2.0  # A connection between neighbors that is this many times too long is torn
CHAIN_ROUND_TRIP_PX, CHAIN_ROUND_TRIP_SHARE = 1.0, 0.05
"""Chained flow loses a point where flow and backward flow disagree by more than this, plus this share of the step."""
FLOW_BYTES = 40  # Memory per pixel while the flow of a pair of frames is computed, bytes
FLOW_CHUNK = 16  # Number of frame pairs whose flow is computed together
TOO_SMALL = f"frames are smaller than {MIN_SIZE_PX} px, the least for optical flow"
END_ERROR = (
    Score(
        "track_end_error_mm", "track end error", "mm", False, 3,
        "Mean distance of points carried to the last frame to the nearest true one there, as in STIR's benchmark.",
        group="motion", hint="0 follows the tissue",
    ),
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
        compare="absolute", group="motion", hint="1 follows the tissue",
    ),
    Score(
        "track_average_jaccard", "average Jaccard", "", True, 3,
        "TP / (TP + FP + FN) of position and visibility at these distances, mean of the five, as in TAP-Vid.",
        compare="absolute", group="motion", hint="1: position and visibility right",
    ),
    Score(
        "track_occlusion_accuracy", "occlusion accuracy", "", True, 3,
        "Share of points whose visibility is predicted right, as in TAP-Vid.",
        compare="absolute", group="motion", hint="1: visibility right",
    ),
)  # fmt: skip
"""Scores that any prediction of tracks has."""
BREAKS = (
    Score(
        "track_fold_rate", "folds", "", False, 4,
        "Share of lines between a point and its nearest neighbors that point against the true line.",
        compare="absolute", group="motion", hint="0: neighbors keep their order",
    ),
    Score(
        "track_tear_rate", "tears", "", False, 4,
        "Share of such lines that are more than twice as long as the true line.",
        compare="absolute", group="motion", hint="0: neighbors stay together",
    ),
)  # fmt: skip
REFERENCES = {"dis": ("flow", "chained optical flow (DIS)"), "still": ("no motion", "no motion")}
"""What stands beside the scene's scores, by the end of the name."""
OF_REFERENCES = tuple(
    score.variant(end, short, what) for score in ACCURACY for end, (short, what) in REFERENCES.items()
)
SCORES = END_ERROR + ACCURACY + BREAKS + OF_REFERENCES
WHY_NOT = {
    "track_error_after_hidden_mm": "no point is hidden and seen again",
    "track_error_near_tool_mm": "no visible point is near a tool",
    "track_error_pulled_mm": "the truth has no such region",
    "track_error_smooth_mm": "the truth has no such region",
}
NO_TRACKS = "no track is visible in two frames"
NO_PAIRS = "no two neighbors are visible together"
BEHIND = "a point is predicted behind the camera"


@dataclass(frozen=True)
class TrueTracks:
    """Every true point that is visible in two frames."""

    points: NDArray[np.float64]  # (T, P, 3) mm
    pixels: NDArray[np.floating]  # (T, P, 2) px
    visible: NDArray[np.bool_]  # (T, P) True where the point is seen
    region: NDArray[np.str_] | None  # (P,) part of the tissue each point lies in, if the truth says so

    @property
    def first(self) -> NDArray[np.intp]:
        """(P,) frame each point starts in: the first that shows it."""
        return self.visible.argmax(0)

    @property
    def counted(self) -> NDArray[np.bool_]:
        """(T, P) True after the frame the point starts in."""
        return np.arange(len(self.visible))[:, None] > self.first

    def at_start(self, values: NDArray) -> NDArray:
        """(P, ...) of (T, P, ...) values: those of the frame in which each point starts."""
        return values[self.first, np.arange(values.shape[1])]


@dataclass(frozen=True)
class PredictedTracks:
    """Positions of the same points by one method; only those after the frame a point starts in count."""

    points: NDArray[np.floating]  # (T, P, 3) mm
    pixels: NDArray[np.floating]  # (T, P, 2) px; infinite where the point is behind the camera
    visible: NDArray[np.bool_]  # (T, P) whether the method says that the frame shows the point


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
    """Every score of `ACCURACY` by name, with the `parts_of`; NaN where nothing counts, infinite without an image."""

    def mean(values: NDArray[np.floating]) -> float:
        return float(values.mean()) if len(values) else math.nan

    def quantile(values: NDArray[np.floating], share: float) -> float:
        """Linear between values as `np.quantile`, but infinite where one of the two is."""
        with np.errstate(invalid="ignore"):
            found = float(np.quantile(values, share)) if len(values) else math.nan
        return math.inf if math.isnan(found) and len(values) else found

    visible = true.visible & true.counted
    # A hidden truth may lie behind the camera: its distance does not count.
    distance_px = np.linalg.norm(predicted.pixels - np.where(np.isfinite(true.pixels), true.pixels, 0), axis=-1)
    distance_mm = np.linalg.norm(predicted.points.astype(np.float64) - true.points, axis=-1)
    return {
        "track_error_mm": mean(distance_mm[visible]),
        "track_error_px": mean(distance_px[visible]),
        "track_error_median_px": quantile(distance_px[visible], 0.5),
        "track_error_p90_px": quantile(distance_px[visible], 0.9),
        **{f"track_error_{part}_mm": mean(distance_mm[visible & chosen]) for part, chosen in parts.items()},
        **track_accuracy(distance_px, predicted.visible, true.visible, true.counted),
    }


def track_accuracy(
    distance_px: NDArray[np.floating],
    predicted_visible: NDArray[np.bool_],
    visible: NDArray[np.bool_],
    counted: NDArray[np.bool_],
) -> dict[str, float]:
    """Shares in [0, 1] by the name of the score, over every (T, P) frame and point that counts; NaN where nothing does.

    A point is a true positive if it is visible, predicted visible and near; a false positive if it is predicted
    visible, but is hidden or far; a false negative if it is visible, but predicted hidden or far. The distance is
    infinite where a prediction has no image; where the truth is hidden, it does not matter.
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
    """Share of folds and of tears between points and their nearest neighbors that start in the same frame, or NaN.

    Of the (frame, pair) both ends of which are `visible`, (T, P): the predicted connection points against the true one;
    it is more than `TEAR_STRETCH` times as long. The truth is known in the frame `first`, (P,).
    """
    folds = tears = total = 0
    for start in np.unique(first):
        group = np.flatnonzero(first == start)
        k = min(NEIGHBORS + 1, len(group))
        _, nearest = KDTree(truth[start, group], leafsize=16).query(truth[start, group], k=k)
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
    return true.visible & np.logical_or.accumulate(true.counted & ~true.visible, axis=0)


def near_tool(true: TrueTracks, sequence: FrameSequence) -> NDArray[np.bool_]:
    """(T, P) where a visible point lies within `NEAR_TOOL_PX` of the tool mask."""
    near = np.zeros_like(true.visible)
    for i, frame in enumerate(sequence.frames("video")):
        if not frame.tissue_mask.all():
            columns, rows = cells_at(true.pixels[i, true.visible[i]], frame.camera.width, frame.camera.height)
            distance = distance_inside(frame.tissue_mask)[rows, columns]
            near[i, true.visible[i]] = distance <= NEAR_TOOL_PX * frame.camera.width / 640
    return near


def track_end_error_mm(scene: Scene, sequence: FrameSequence) -> float:
    """Mean distance of points carried from the first to the last frame to the nearest true point there, mm: the error
    of STIR's benchmark, for tracks that are not paired; NaN if no point is known at start or end.
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


def true_tracks(sequence: FrameSequence) -> TrueTracks | None:
    """The paired tracks of the ground truth; None if there are none with two frames that show the same point."""
    tracks = sequence.truth and sequence.truth.tracks
    if not tracks or not tracks.paired:
        return None
    chosen = tracks.visible.sum(0) > 1
    if not chosen.any():
        return None
    points = tracks.points[:, chosen].astype(np.float64)
    pixels = np.stack([_pixels(p, sequence.camera(i)) for i, p in enumerate(points)])
    region = None if tracks.region is None else tracks.region[chosen]
    return TrueTracks(points, pixels, tracks.visible[:, chosen], region)


def by_scene(scene: Scene, true: TrueTracks, sequence: FrameSequence) -> PredictedTracks:
    """Points carried by the Gaussians; visible where neither rendered tissue nor the tool mask hides them."""
    times = frame_times(len(sequence))
    world = carry_points(scene, _world_starts(true, sequence), true.first, times)
    tracks = _in_frames(world, sequence)
    for i, frame in enumerate(sequence.frames("video")):
        tracks.visible[i] &= project_visible(world[i], render_surface(scene, frame.time, frame.camera))[1]
    return tracks


def without_motion(true: TrueTracks, sequence: FrameSequence) -> PredictedTracks:
    """Points that stay where they start; with a moving camera, where they start in the world."""
    starts = _world_starts(true, sequence)
    return _in_frames(np.broadcast_to(starts, (len(sequence), *starts.shape)), sequence)


def by_chained_flow(true: TrueTracks, sequence: FrameSequence) -> PredictedTracks:
    """The true points, moved from where they start as in `chained_flow`."""
    return chained_flow(true.at_start(true.points), true.first, sequence)


def chained_flow(starts: NDArray[np.floating], first: NDArray[np.intp], sequence: FrameSequence) -> PredictedTracks:
    """Points moved from frame to frame by optical flow (DIS), held-out frames included; a lost point moves on too.

    A point is visible in a frame unless it is outside of the image, under the tool mask, or the backward flow does not
    return to where it came from. Its depth is the measured one at its pixel, else the last known one.
    ScoreUnavailable where the frames are too small for optical flow.

    Args:
        starts: (P, 3) where each point starts, in camera axes of the frame `first` (P,), mm.
    """
    frames, camera = sequence.frames("video"), sequence.camera(0)
    if min(camera.width, camera.height) < MIN_SIZE_PX:
        raise ScoreUnavailable(TOO_SMALL)
    depth = starts[:, 2]
    pixels = np.tile(_pixels(starts, camera), (len(sequence), 1, 1))
    points, visible = np.tile(starts, (len(sequence), 1, 1)), np.zeros((len(sequence), len(starts)), bool)
    for k, (there, back) in enumerate(_flows(frames)):
        frame, moving = frames[k + 1], first <= k
        step = _flow_at(there, pixels[k], frame)
        pixels[k + 1] = np.where(moving[:, None], pixels[k] + step, pixels[k])
        gap = np.linalg.norm(step + _flow_at(back, pixels[k + 1], frame), axis=-1)
        returns = gap <= CHAIN_ROUND_TRIP_PX + CHAIN_ROUND_TRIP_SHARE * np.linalg.norm(step, axis=-1)
        shown = shown_pixels(pixels[k + 1], frame.tissue_mask)
        x, y = cells_at(pixels[k + 1], frame.camera.width, frame.camera.height)
        depth = np.where(moving & shown & frame.depth_valid[y, x], frame.depth[y, x], depth)
        points[k + 1] = back_project(pixels[k + 1], depth, _at_origin(frame.camera))
        visible[k + 1] = moving & shown & returns
    return PredictedTracks(points, pixels, visible)


def _in_frames(world: NDArray[np.floating], sequence: FrameSequence) -> PredictedTracks:
    """World points (T, P, 3) as each frame's camera sees them, visible where the frame shows tissue."""
    points, pixels, visible = [], [], []
    for at, frame in zip(world, sequence.frames("video"), strict=True):
        pose = frame.camera.world_to_camera
        points.append(at @ pose[:3, :3].T + pose[:3, 3])
        pixels.append(_pixels(points[-1], frame.camera))
        visible.append(shown_pixels(pixels[-1], frame.tissue_mask))
    return PredictedTracks(np.stack(points), np.stack(pixels), np.stack(visible))


def _world_starts(true: TrueTracks, sequence: FrameSequence) -> NDArray[np.float64]:
    """(P, 3) world position of each point in the frame it starts in, mm."""
    to_world = camera_to_world(sequence.camera(i) for i in range(len(sequence)))[true.first]
    return np.einsum("pij,pj->pi", to_world[:, :3, :3], true.at_start(true.points)) + to_world[:, :3, 3]


def _at_origin(camera: Camera) -> Camera:
    return replace(camera, world_to_camera=np.eye(4))


def _pixels(points: NDArray[np.floating], camera: Camera) -> NDArray[np.float64]:
    """(P, 2) pixels of points in camera axes; infinite behind the camera."""
    pixels, z = project(points, _at_origin(camera))
    return np.where((z > 0)[:, None], pixels, np.inf)


def _flow_at(flow: NDArray[np.float32], pixels: NDArray[np.floating], frame: Frame) -> NDArray[np.float64]:
    """(P, 2) flow at pixels of the frame, in px of the frame; at a border beyond the image."""
    scale = np.array([frame.camera.width / flow.shape[1], frame.camera.height / flow.shape[0]])
    return bilinear(flow, pixels / scale) * scale


def _flows(frames: Sequence[Frame]) -> Iterator[tuple[NDArray[np.float32], NDArray[np.float32]]]:
    """The flows from frame k to k + 1 and back: the same fine flow from which training starts."""
    camera = frames[0].camera
    shrink = fine_shrink(camera.height, camera.width)

    def pair(first: Image, second: Image) -> tuple[NDArray[np.float32], NDArray[np.float32]]:
        return fine_flow(first, second), fine_flow(second, first)

    with ThreadPoolExecutor(workers(FLOW_BYTES * camera.width * camera.height)) as pool:  # OpenCV releases the lock
        for start in range(0, len(frames) - 1, FLOW_CHUNK):
            chunk = range(start, min(start + FLOW_CHUNK + 1, len(frames)))
            grays = [gray_for_flow(frames[k].rgb_u8, shrink) for k in chunk]
            yield from pool.map(pair, grays[:-1], grays[1:])
