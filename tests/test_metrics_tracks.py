"""Accuracy of tracks by hand, by slow loops, and on frames with known motion; chained flow and no motion."""

from __future__ import annotations

from pathlib import Path
from types import SimpleNamespace

import cv2
import numpy as np
import pytest
from scipy.spatial import cKDTree

from endoprior.core.types import Camera, Frame
from endoprior.data import FrameSequence, load_sequence
from endoprior.data.truth import Tracks
from endoprior.evaluation.score import ScoreUnavailable
from endoprior.evaluation.scorers.tracks import (
    PredictedTracks,
    by_chained_flow,
    near_tool,
    neighbor_breaks,
    parts_of,
    seen_again,
    track_accuracy,
    track_scores,
    true_tracks,
    without_motion,
)
from endoprior.phantom import PhantomConfig, write_phantom

WIDTH, HEIGHT, NUM_FRAMES, DEPTH, FOCAL = 160, 128, 6, 50.0, 200.0
CAMERA = Camera(WIDTH, HEIGHT, FOCAL, FOCAL, WIDTH / 2, HEIGHT / 2, np.eye(4))


def rows(*values: str) -> np.ndarray:
    """(T, P) bool from rows of digits."""
    return np.array([[c == "1" for c in row] for row in values])


# --- metrics ---------------------------------------------------------------------------------------------------------


def test_accuracy_of_three_points_by_hand():
    """Point 0 is right, point 1 is 10 px off, point 2 is hidden but predicted visible; frame 0 does not count."""
    visible, predicted = rows("111", "110"), rows("111", "111")
    distance = np.array([[0, 0, 0], [0.0, 10.0, 0.0]])
    accuracy = track_accuracy(distance, predicted, visible, rows("000", "111"))
    # within 4 and 8 px one of the two visible points, within 16, 32 and 64 px both
    assert accuracy["track_delta_avg"] == pytest.approx((2 * 0.5 + 3 * 1) / 5)
    # TP 1, FP 2 (far, hidden), FN 1 (far); then TP 2, FP 1 (hidden)
    assert accuracy["track_average_jaccard"] == pytest.approx((2 * 1 / 4 + 3 * 2 / 3) / 5)
    assert accuracy["track_occlusion_accuracy"] == pytest.approx(2 / 3)


def test_a_visible_point_predicted_hidden_is_near_but_no_true_positive():
    accuracy = track_accuracy(np.zeros((1, 2)), rows("10"), rows("11"), rows("11"))
    assert list(accuracy.values()) == [1.0, 0.5, 0.5]
    assert np.isnan(list(track_accuracy(np.zeros((1, 2)), rows("10"), rows("00"), rows("11")).values())).all()


def test_accuracy_against_slow_loops():
    rng = np.random.default_rng(0)
    distance = rng.exponential(20, (7, 9))
    distance[2, 3] = np.inf
    predicted, visible, counted = (rng.random((3, 7, 9)) < 0.6).astype(bool)
    jaccards, deltas = [], []
    for threshold in (4, 8, 16, 32, 64):
        tp = fp = fn = near = total = 0
        for t in range(7):
            for p in range(9):
                if not counted[t, p]:
                    continue
                close = distance[t, p] <= threshold
                tp += visible[t, p] and predicted[t, p] and close
                fp += predicted[t, p] and not (visible[t, p] and close)
                fn += visible[t, p] and not (predicted[t, p] and close)
                near += visible[t, p] and close
                total += visible[t, p]
        jaccards.append(tp / (tp + fp + fn))
        deltas.append(near / total)
    right = [predicted[t, p] == visible[t, p] for t in range(7) for p in range(9) if counted[t, p]]
    accuracy = track_accuracy(distance, predicted, visible, counted)
    assert list(accuracy.values()) == pytest.approx([np.mean(deltas), np.mean(jaccards), np.mean(right)])
    assert accuracy["track_average_jaccard"] <= accuracy["track_delta_avg"]  # being seen can only cost


# --- true tracks ------------------------------------------------------------------------------------------------------


def moving_plane(
    step_px: float, *, tool: slice | None = None, points: tuple[tuple[float, float], ...] = ((60.5, 60.5), (90.5, 40.5))
) -> FrameSequence:
    """A textured plane 50 mm away that moves right by `step_px` a frame, and points on it; a tool over columns."""
    noise = np.random.default_rng(0).random((HEIGHT, WIDTH + 200, 3)).astype(np.float32)
    texture = cv2.GaussianBlur(noise, (0, 0), 3)
    texture = (texture - texture.min()) / (texture.max() - texture.min())
    frames, tracks, visible = [], [], []
    for i in range(NUM_FRAMES):
        shift = np.array([[1, 0, step_px * i - 100], [0, 1, 0]], np.float32)
        mask = np.ones((HEIGHT, WIDTH), bool)
        if tool is not None:
            mask[:, tool] = False
        rgb = (255 * cv2.warpAffine(texture, shift, (WIDTH, HEIGHT))).astype(np.uint8)
        depth = np.where(mask, DEPTH, 20).astype(np.float32)
        frames.append(Frame(i, i / NUM_FRAMES, CAMERA, rgb, mask, depth, np.ones((HEIGHT, WIDTH), bool)))
        pixels = np.array(points) + np.array([step_px * i, 0])
        x, y = ((pixels - [WIDTH / 2, HEIGHT / 2]) * DEPTH / FOCAL).T
        tracks.append(np.stack([x, y, np.full_like(x, DEPTH)], -1))
        inside = (pixels[:, 0] >= 0) & (pixels[:, 0] < WIDTH)
        column = pixels[:, 0].astype(int).clip(0, WIDTH - 1)
        visible.append(inside & mask[pixels[:, 1].astype(int), column])
    sequence = FrameSequence(Path("plane"), [CAMERA] * NUM_FRAMES, frames.__getitem__)
    sequence.truth = SimpleNamespace(tracks=Tracks(np.stack(tracks).astype(np.float32), np.stack(visible)))
    return sequence


def scored(predicted: PredictedTracks, true, sequence: FrameSequence) -> dict[str, float]:
    """All scores of a prediction."""
    return track_scores(predicted, true, parts_of(true, sequence))


def perfect(true) -> PredictedTracks:
    """The truth as a prediction."""
    return PredictedTracks(true.points, true.pixels, true.visible)


@pytest.fixture(scope="module")
def phantom(tmp_path_factory):
    """A small phantom whose tissue slides, with smooth patches: it has regions, and points that leave and return."""
    out = tmp_path_factory.mktemp("tracks") / "phantom"
    write_phantom(out, PhantomConfig(frames=12, width=96, height=80, slide_mm=12, smooth_share=0.4))
    return load_sequence(out)


def test_true_tracks_as_predictions_are_perfect(phantom):
    true = true_tracks(phantom)
    scores = scored(perfect(true), true, phantom)
    shares = {"track_delta_avg", "track_average_jaccard", "track_occlusion_accuracy"}
    assert {name: scores[name] for name in shares} == dict.fromkeys(shares, 1.0)
    assert all(value == 0 for name, value in scores.items() if name not in shares), scores


def test_an_offset_is_the_error_of_every_part(phantom):
    true = true_tracks(phantom)
    moved = PredictedTracks(true.points + np.array([0, 3, 4]), true.pixels + np.array([6, 8]), true.visible)
    scores = scored(moved, true, phantom)
    for name in ("", "_after_hidden", "_near_tool", "_pulled", "_smooth"):
        assert scores[f"track_error{name}_mm"] == pytest.approx(5)
    assert scores["track_error_median_px"] == scores["track_error_p90_px"] == pytest.approx(10)
    assert scores["track_delta_avg"] == scores["track_average_jaccard"] == pytest.approx(3 / 5)


def test_points_behind_the_camera_are_infinitely_far():
    true = true_tracks(moving_plane(1.0))
    lost = PredictedTracks(-true.points, np.full_like(true.pixels, np.inf), ~true.visible)
    scores = scored(lost, true, moving_plane(1.0))
    assert (scores["track_delta_avg"], scores["track_average_jaccard"]) == (0, 0)
    assert scores["track_error_median_px"] == scores["track_error_p90_px"] == np.inf
    assert scores["track_error_px"] == np.inf and np.isnan(scores["track_error_pulled_mm"])


def test_a_point_that_appears_late_counts_from_the_frame_after():
    sequence = moving_plane(0.0, points=((20.5, 20.5), (40.5, 20.5), (60.5, 20.5)))
    tracks = sequence.truth.tracks
    tracks.visible[:] = rows("100", "010", "111", "101", "001", "111")
    true = true_tracks(sequence)
    assert true.first.tolist() == [0, 1, 2]
    assert (true.counted == rows("000", "100", "110", "111", "111", "111")).all()
    # hidden before it starts or in the frame it starts in: not seen again; point 2 is never hidden after it starts
    assert (seen_again(true) == rows("000", "000", "100", "100", "000", "110")).all()


def test_near_the_tool_is_forty_px_of_an_image_640_px_wide():
    limit = 40 * WIDTH / 640
    inside, outside = 100.5 - limit, 99.5 - limit  # the tool starts at column 100, centered at 100.5
    sequence = moving_plane(0.0, tool=slice(100, 110), points=((inside, 60.5), (outside, 60.5), (105.5, 60.5)))
    sequence.truth.tracks.visible[0, 2] = sequence.truth.tracks.visible[1, 2] = True
    near = near_tool(true_tracks(sequence), sequence)
    assert near[:, :2].tolist() == [[True, False]] * NUM_FRAMES
    assert near[:, 2].tolist() == [True, True, False, False, False, False], "a hidden point does not count"
    assert not near_tool(true_tracks(moving_plane(0.0)), moving_plane(0.0)).any()


# --- references -------------------------------------------------------------------------------------------------------


def test_no_motion_of_static_tissue_is_perfect():
    sequence = moving_plane(0.0, tool=slice(80, 95))
    true = true_tracks(sequence)
    scores = scored(without_motion(true, sequence), true, sequence)
    assert scores["track_error_mm"] == pytest.approx(0, abs=1e-6) and scores["track_average_jaccard"] == 1


def test_no_motion_errs_by_the_motion():
    sequence = moving_plane(4.0)
    true = true_tracks(sequence)
    scores = scored(without_motion(true, sequence), true, sequence)
    steps = np.arange(1, NUM_FRAMES) * 4.0
    assert scores["track_error_px"] == pytest.approx(steps.mean(), rel=1e-5)
    assert scores["track_error_mm"] == pytest.approx(steps.mean() * DEPTH / FOCAL, rel=1e-5)
    assert scores["track_error_p90_px"] == pytest.approx(np.quantile(np.repeat(steps, 2), 0.9), rel=1e-5)


def test_chained_flow_follows_a_moving_plane():
    sequence = moving_plane(3.0)
    true = true_tracks(sequence)
    tracks = by_chained_flow(true, sequence)
    np.testing.assert_allclose(tracks.pixels, true.pixels, atol=0.5)
    np.testing.assert_allclose(tracks.points, true.points, atol=0.5 * DEPTH / FOCAL)
    scores = scored(tracks, true, sequence)
    assert scores["track_average_jaccard"] == 1 and scores["track_error_px"] < 0.5


def test_chained_flow_starts_where_a_point_is_first_seen():
    sequence = moving_plane(3.0)
    sequence.truth.tracks.visible[:3, 1] = False
    true = true_tracks(sequence)
    tracks = by_chained_flow(true, sequence)
    np.testing.assert_allclose(tracks.pixels[3:], true.pixels[3:], atol=0.5)
    assert (tracks.pixels[:4, 1] == true.pixels[3, 1]).all()


def test_chained_flow_under_the_tool_moves_on_hidden_at_its_last_depth():
    sequence = moving_plane(4.0, tool=slice(70, 78), points=((60.5, 60.5),))
    true = true_tracks(sequence)
    tracks = by_chained_flow(true, sequence)
    assert tracks.visible[1:, 0].tolist() == true.visible[1:, 0].tolist() == [True, True, False, False, True]
    np.testing.assert_allclose(tracks.points[:, 0, 2], DEPTH)  # not the tool's 20 mm
    np.testing.assert_allclose(tracks.pixels, true.pixels, atol=0.7)


def test_chained_flow_hides_points_outside_of_the_image_and_those_whose_flow_does_not_return():
    sequence = moving_plane(6.0, points=((142.5, 60.5), (60.5, 60.5)))
    tracks = by_chained_flow(true_tracks(sequence), sequence)
    assert not tracks.visible[4:, 0].any() and np.isfinite(tracks.pixels).all()
    sequence = moving_plane(0.0)
    for index in range(3, NUM_FRAMES):  # other tissue: no flow leads back
        sequence.frame(index).rgb_u8[:] = np.random.default_rng(index).integers(0, 255, (HEIGHT, WIDTH, 3), np.uint8)
    tracks = by_chained_flow(true_tracks(sequence), sequence)
    assert tracks.visible[1:3].all() and not tracks.visible[3:].all() and np.isfinite(tracks.points).all()


def test_flow_needs_frames_of_some_size():
    small = Camera(24, 24, 30.0, 30.0, 12.0, 12.0, np.eye(4))
    sequence = FrameSequence(Path("small"), [small] * 3, lambda index: None)
    sequence.truth = SimpleNamespace(tracks=Tracks(np.ones((3, 1, 3), np.float32), np.ones((3, 1), bool)))
    with pytest.raises(ScoreUnavailable, match="smaller than 32 px"):
        by_chained_flow(true_tracks(sequence), sequence)


# --- folds and tears


def grid_of_points(frames: int = 3) -> np.ndarray:
    """(T, 16, 3) a resting 4 x 4 grid of points, 1 mm apart."""
    x, y = np.meshgrid(np.arange(4.0), np.arange(4.0))
    return np.tile(np.stack([x.ravel(), y.ravel(), np.full(16, 50.0)], -1), (frames, 1, 1))


def breaks(predicted: np.ndarray, truth: np.ndarray, first: int = 0):
    visible = np.ones(truth.shape[:2], bool)
    visible[first] = False
    return neighbor_breaks(predicted, truth, visible, np.full(truth.shape[1], first))


def test_tissue_that_moves_or_turns_as_one_neither_folds_nor_tears():
    truth = grid_of_points()
    assert breaks(truth + np.array([3, -1, 2]), truth) == (0, 0)
    angle = np.radians(80)
    turn = np.array([[np.cos(angle), -np.sin(angle), 0], [np.sin(angle), np.cos(angle), 0], [0, 0, 1]])
    assert breaks(truth @ turn.T, truth) == (0, 0)
    assert breaks(truth * 1.9, truth) == (0, 0)


def test_turned_inside_out_is_all_fold_and_stretched_is_all_tear():
    truth = grid_of_points()
    assert breaks(-truth, truth) == (1, 0)
    assert breaks(truth * 2.1, truth) == (0, 1)


def test_one_lost_point_tears_its_own_pairs_only():
    truth = grid_of_points()
    predicted = truth.copy()
    predicted[2, 5] += [0, 0, 30]
    pairs = {tuple(sorted((a, b))) for a in range(16) for b in nearest_four(truth[0], a)}
    own = [pair for pair in pairs if 5 in pair]
    fold, tear = breaks(predicted, truth)
    assert fold == 0 and tear == pytest.approx(len(own) / (2 * len(pairs)))


def nearest_four(points: np.ndarray, a: int) -> list[int]:
    return [int(b) for b in cKDTree(points).query(points[a], k=5)[1] if b != a]


def test_breaks_need_a_pair_that_both_frames_show():
    truth = grid_of_points()
    assert np.isnan(neighbor_breaks(truth, truth, np.zeros((3, 16), bool), np.zeros(16, int))).all()
    alone = neighbor_breaks(truth[:, :2], truth[:, :2], np.ones((3, 2), bool), np.array([0, 1]))
    assert np.isnan(alone).all()  # they start in different frames
