"""Depth stability, folds and tears of tracks, against closed forms."""

from __future__ import annotations

import subprocess
import sys

import numpy as np
import pytest

from endoprior.evaluation.scorers.depth import depth_instability
from endoprior.evaluation.scorers.tracks import neighbor_breaks

ALL = np.ones((6, 8), bool)


def test_instability_of_a_surface_that_moves_as_one():
    depth = np.linspace(40, 90, 48).reshape(6, 8)
    assert depth_instability(depth, depth - 1.5, ALL, ALL) == pytest.approx(1.5)
    assert depth_instability(depth, depth, ALL, ALL) == 0


def test_instability_counts_pixels_that_are_tissue_and_drawn_in_both_frames():
    depth_a, depth_b = np.full((1, 5), 10.0), np.full((1, 5), 12.0)
    mask_a, mask_b = np.ones((1, 5), bool), np.ones((1, 5), bool)
    depth_a[0, 0], depth_b[0, 1] = 0, 0  # not rendered in one of them
    mask_a[0, 2] = mask_b[0, 3] = False
    depth_b[0, 2] = depth_a[0, 3] = np.nan  # outside the masks: may be anything
    depth_b[0, 4] = 17
    assert depth_instability(depth_a, depth_b, mask_a, mask_b) == 7


def test_instability_without_a_common_pixel_is_nan():
    assert np.isnan(depth_instability(np.ones((6, 8)), np.ones((6, 8)), ALL, ~ALL))
    assert np.isnan(depth_instability(np.zeros((6, 8)), np.ones((6, 8)), ALL, ALL))


def test_instability_names_bad_input():
    depth = np.ones((6, 8))
    with pytest.raises(ValueError, match="depth at valid pixels must be finite"):
        depth_instability(depth, np.full((6, 8), np.nan), ALL, ALL)
    with pytest.raises(ValueError, match="must be bool"):
        depth_instability(depth, depth, ALL, ALL.astype(int))
    with pytest.raises(ValueError, match="must have shape"):
        depth_instability(depth, depth[1:], ALL, ALL)


def test_metrics_import_without_torch():
    module = "endoprior.evaluation.scorers.depth"
    code = f"import sys, {module}; print('torch' in sys.modules, 'torchvision' in sys.modules)"
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    assert done.stdout.split() == ["False", "False"]


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
    from scipy.spatial import cKDTree

    return [int(b) for b in cKDTree(points).query(points[a], k=5)[1] if b != a]


def test_breaks_need_a_pair_that_both_frames_show():
    truth = grid_of_points()
    assert np.isnan(neighbor_breaks(truth, truth, np.zeros((3, 16), bool), np.zeros(16, int))).all()
    alone = neighbor_breaks(truth[:, :2], truth[:, :2], np.ones((3, 2), bool), np.array([0, 1]))
    assert np.isnan(alone).all()  # they start in different frames
