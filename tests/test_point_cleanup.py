"""Cleaning a cloud and sizing its points, against literal loops."""

from __future__ import annotations

import math

import numpy as np
import pytest

from endoprior.initialization.sampling import (
    PointCloud,
    concatenated,
    initial_log_scales,
    merge_voxels,
    remove_outliers,
)


def cloud_of(points: np.ndarray, colors: np.ndarray) -> PointCloud:
    """A cloud whose points come from frames 0, 1, 2, ..."""
    return PointCloud(points, colors, np.arange(len(points), dtype=np.int32))


# --- clean-up


def test_voxel_merge_matches_loop():
    rng = np.random.default_rng(2)
    cloud = cloud_of(rng.random((300, 3), np.float32) * [10, 5, 2], rng.random((300, 3), np.float32))
    low = [min(p[k] for p in cloud.points) for k in range(3)]
    side = max(max(p[k] for p in cloud.points) - low[k] for k in range(3)) / 8
    voxels: dict[tuple[int, ...], list[int]] = {}
    for i, point in enumerate(cloud.points):
        key = tuple(math.floor((point[k] - low[k]) / side + 0.5) for k in range(3))
        voxels.setdefault(key, []).append(i)
    merged = merge_voxels(cloud, 8)
    assert len(merged) == len(voxels) < 200
    for row, key in enumerate(sorted(voxels)):
        # float32 results of float64 means
        np.testing.assert_allclose(merged.points[row], cloud.points[voxels[key]].mean(0), rtol=1e-5)
        np.testing.assert_allclose(merged.colors[row], cloud.colors[voxels[key]].mean(0), rtol=1e-5)
        assert merged.origins[row] == voxels[key][0]


def test_voxel_merge_does_not_depend_on_the_order():
    rng = np.random.default_rng(3)
    cloud = cloud_of(rng.random((200, 3), np.float32), rng.random((200, 3), np.float32))
    order = rng.permutation(200)
    shuffled = cloud_of(cloud.points[order], cloud.colors[order])
    np.testing.assert_allclose(merge_voxels(cloud, 5).points, merge_voxels(shuffled, 5).points, rtol=1e-6)  # float32


def test_coinciding_and_empty_clouds():
    point = np.full((5, 3), 2.5, np.float32)
    colors = np.linspace(0, 1, 15, dtype=np.float32).reshape(5, 3)
    merged = merge_voxels(cloud_of(point, colors), 400)
    np.testing.assert_array_equal(merged.points, [[2.5, 2.5, 2.5]])
    np.testing.assert_allclose(merged.colors, [colors.mean(0)], rtol=1e-6)
    empty = cloud_of(point[:0], colors[:0])
    assert len(merge_voxels(empty, 400)) == len(remove_outliers(empty, 20, 1.5)) == 0
    assert len(remove_outliers(cloud_of(point, colors), 20, 1.5)) == 5


def test_outlier_removal_matches_loop():
    rng = np.random.default_rng(4)
    points = rng.standard_normal((80, 3)).astype(np.float32)
    points[:3] *= 20
    cloud = cloud_of(points, rng.random((80, 3), np.float32))
    average = []
    for a in points.astype(float):
        nearest = sorted(math.dist(a, b) for b in points.astype(float))[:6]  # the first is the point itself
        average.append(sum(nearest) / 6)
    mean = sum(average) / 80
    deviation = math.sqrt(sum((x - mean) ** 2 for x in average) / 79)
    # just enough standard deviations to keep the fourth largest: tells n - 1 from n in the denominator
    num_std = (sorted(average)[-4] - mean) / deviation * (1 + 1e-5)
    keep = [x <= mean + num_std * deviation for x in average]
    assert sum(keep) == 77
    kept = remove_outliers(cloud, 6, num_std)
    np.testing.assert_array_equal(kept.points, points[keep])
    np.testing.assert_array_equal(kept.colors, cloud.colors[keep])
    assert not any(keep[:3])


# --- scales


def test_log_scales_match_loop():
    points = np.random.default_rng(5).random((60, 3)).astype(np.float32) * 30
    want = []
    for i, a in enumerate(points.astype(float)):
        squared = sorted(math.dist(a, b) ** 2 for j, b in enumerate(points.astype(float)) if j != i)
        want.append(0.5 * math.log(0.4 * sum(squared[:3]) / 3))
    got = initial_log_scales(points, 0.4)
    assert got.shape == (60,) and got.dtype == np.float32
    np.testing.assert_allclose(got, want, atol=1e-6)  # float32 result


def test_scale_of_a_grid_is_its_spacing():
    grid = np.stack(np.meshgrid(*[np.arange(5.0)] * 3), -1).reshape(-1, 3) * 2.5
    np.testing.assert_allclose(np.exp(initial_log_scales(grid)), 2.5, rtol=1e-6)


def test_coinciding_points_get_the_minimum_scale():
    points = np.zeros((9, 3), np.float32)
    points[8] = 7
    scales = np.exp(initial_log_scales(points, 0.4))
    np.testing.assert_allclose(scales[:8], math.sqrt(0.4e-7), rtol=1e-5)  # float32
    assert scales[8] == pytest.approx(math.sqrt(0.4 * 3 * 49), rel=1e-5)


@pytest.mark.parametrize("points", [np.zeros((3, 3)), np.full((9, 3), np.nan), np.zeros((9, 2)), np.zeros((0, 3))])
def test_invalid_points_are_named(points):
    with pytest.raises(ValueError, match="points must"):
        initial_log_scales(points)


def test_concatenated_keeps_order_and_origins():
    rng = np.random.default_rng(5)
    cloud = cloud_of(rng.random((10, 3), np.float32), rng.random((10, 3), np.float32))
    again = concatenated([cloud.subset(np.arange(4)), cloud.subset(np.arange(10) >= 4)])
    for name in ("points", "colors", "origins"):
        np.testing.assert_array_equal(getattr(again, name), getattr(cloud, name))
    assert len(concatenated([])) == 0
