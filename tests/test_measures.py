"""Measures over time: closed forms first, then a scene whose motion is known, then the files."""

import numpy as np
import pytest

from endoprior.model.measures import (
    area,
    distance,
    measures_of,
    neighborhoods,
    path_length,
    polygon_triangles,
    principal_stretches,
    smoothed,
)


def turned(points: np.ndarray, seed: int = 0) -> np.ndarray:
    """Points (..., 3) after some rotation and translation."""
    axes, _ = np.linalg.qr(np.random.default_rng(seed).normal(size=(3, 3)))
    axes[:, 0] *= np.linalg.det(axes)
    return points @ axes.T + [3.0, -2.0, 50.0]


def patch(curved: bool) -> np.ndarray:
    """(12, 3) points anywhere on a plane or on a bowl."""
    x, y = np.random.default_rng(1).uniform(-2, 2, (2, 12))
    return np.stack([x, y, 0.2 * x * x + 0.1 * x * y if curved else 0 * x], -1)


def test_distance_and_path_of_a_uniform_motion():
    paths = np.arange(8)[:, None, None] * np.array([[3.0, 4, 0], [0, 0, 0]])
    assert distance(paths[:, 0], paths[:, 1]) == pytest.approx(5 * np.arange(8))
    assert path_length(paths)[:, 0] == pytest.approx(5 * np.arange(8)) and not path_length(paths)[:, 1].any()
    assert smoothed(paths) == pytest.approx(paths)  # constant velocity stays, at the ends too
    assert path_length(paths[:1]).tolist() == [[0, 0]]


def test_jitter_adds_path_length_and_smoothing_takes_most_of_it_away():
    jitter = np.random.default_rng(0).normal(size=(400, 50, 3))
    raw, smooth = path_length(jitter)[-1].mean() / 399, path_length(smoothed(jitter))[-1].mean() / 399
    assert raw == pytest.approx(4 / np.sqrt(np.pi), rel=0.02)  # the mean length of a normal vector of variance 2
    assert smooth < 0.3 * raw


@pytest.mark.parametrize(
    ("corners", "expected"),
    [
        ([(0, 0), (4, 0), (0, 3)], 6),
        ([(0, 0), (4, 0), (4, 2), (0, 2)], 8),
        ([(0, 0), (0, 2), (4, 2), (4, 0)], 8),  # clockwise
        ([(0, 0), (4, 0), (4, 4), (2, 1), (0, 4)], 10),  # a notch
        ([(0, 0), (6, 0), (6, 3), (5, 3), (5, 1), (1, 1), (1, 3), (0, 3)], 10),  # a U
    ],
)
def test_area_of_a_polygon_however_it_lies(corners, expected):
    flat = turned(np.column_stack([np.array(corners, float), np.zeros(len(corners))]))
    triangles = polygon_triangles(flat)
    assert len(triangles) == len(corners) - 2
    assert area(np.stack([flat, 2 * flat]), triangles) == pytest.approx([expected, 4 * expected])


@pytest.mark.parametrize(
    "corners",
    [[(0, 0), (1, 0)], [(0, 0), (1, 1), (2, 2)], [(0, 0), (4, 2), (4, 0), (0, 3)], [(0, 0), (1, np.nan), (1, 1)]],
)
def test_corners_that_surround_nothing_have_no_triangles(corners):
    assert not len(polygon_triangles(np.column_stack([np.array(corners, float), np.zeros(len(corners))])))


@pytest.mark.parametrize("curved", [False, True])
def test_a_rigid_motion_does_not_stretch_and_a_uniform_scaling_stretches_by_its_factor(curved):
    before = turned(patch(curved), 2)
    assert principal_stretches(before, turned(before, 3)) == pytest.approx([1, 1])
    assert principal_stretches(before, turned(1.2 * before, 3)) == pytest.approx([1.2, 1.2])


def test_stretch_along_one_direction_leaves_the_other():
    before, after = patch(False), patch(False) * [1.3, 1, 1]
    assert principal_stretches(turned(before, 2), turned(after, 3)) == pytest.approx([1.3, 1])
    shear = patch(False) @ np.array(
        [[1, 0, 0], [0.5, 1, 0], [0, 0, 1.0]]
    )  # x + y / 2: singular values of [[1, .5], [0, 1]]
    assert principal_stretches(before, shear) == pytest.approx(np.linalg.svd([[1, 0.5], [0, 1]])[1])


def test_stretch_of_what_is_unknown_or_thin_is_unknown():
    known = patch(True)
    broken, line = known.copy(), known * [1, 0, 0]
    broken[3, 1] = np.nan
    found = principal_stretches(np.stack([known, broken, known, line]), np.stack([known, known, broken, line]))
    assert np.isfinite(found[0]).all() and np.isnan(found[1:]).all()


def test_neighbors_lie_around_a_point_or_it_is_beyond_the_surface():
    x, y = (part.ravel() for part in np.meshgrid(np.arange(20.0), np.arange(20.0)))
    samples = np.stack([x, y, 0 * x], -1)
    nearest, around = neighborhoods(np.array([[10.0, 10, 0.1], [0, 0, 0], [10, -4, 0], [10, 10, 9]]), samples)
    assert samples[nearest[0, 0]].tolist() == [10, 10, 0] and nearest.shape == (4, 24)
    assert around.tolist() == [True, True, False, False]  # a corner still is part of the surface


def test_measures_of_three_points():
    start = np.array([[0.0, 0, 50], [4, 0, 50], [0, 3, 50]])
    paths = start + np.array([0.0, 1, 2, 3, 4])[:, None, None] * [0, 0, 2.0]
    found = measures_of(paths, np.ones((5, 3)), since=1, drawn=2)
    assert found.distance == pytest.approx([4] * 5) and found.area == pytest.approx([6] * 5)
    assert found.path_length[:, 2] == pytest.approx([0, 2, 4, 6, 8]) == found.path_length_raw[:, 0].tolist()
    assert found.displacement[:, 1].tolist() == [2, 0, 2, 4, 6]
    alone = measures_of(paths[:, :1], np.ones((5, 1)), 0, 0)
    assert np.isnan(alone.distance).all() and np.isnan(alone.area).all()
