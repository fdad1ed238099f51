"""Cameras, look-ups, orders and neighbors on generated points."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from hypothesis_profiles import examples
from render_scenes import camera

from endoprior.compute.morton import morton_order
from endoprior.core.geometry import back_project, bilinear, expected_depth, pixel_centers, project, quaternion_to_matrix
from endoprior.data.pixels import shrunk_camera
from endoprior.model.basis import frame_weights, spline_weights
from endoprior.training.local_motion import neighbors_numba as neighbors

SEEDS = st.integers(0, 2**31 - 1)
SIDES = st.integers(1, 60)


@given(SIDES, SIDES, SEEDS, st.integers(0, 40))
def test_projection_undoes_back_projection(width, height, seed, num):
    view, rng = camera(width, height, seed=seed), np.random.default_rng(seed)
    pixels = rng.uniform(-0.5, 1.5, (num, 2)) * [width, height]
    depth = 10.0 ** rng.uniform(-1, 6, num)
    points = back_project(pixels, depth, view)
    again, z = project(points, view)
    np.testing.assert_allclose(z, depth, rtol=1e-9, atol=1e-9)
    near = depth > 1  # nearer ones lose digits to the camera's own position
    np.testing.assert_allclose(again[near], pixels[near], atol=1e-6)
    np.testing.assert_allclose(view.world_to_camera[:3, :3] @ view.center + view.world_to_camera[:3, 3], 0, atol=1e-9)


@given(st.sampled_from([0.0, 1e-300, -1e-300, 1e-12, -3.0]), SEEDS)
def test_points_beside_and_behind_the_camera_project_to_numbers(z, seed):
    view = replace(camera(20, 10, seed=None), world_to_camera=np.eye(4))
    points = np.append(np.random.default_rng(seed).normal(size=2), z)[None]
    pixels, found = project(points, view)
    assert np.isfinite(pixels).all() and found[0] == z


@given(SIDES, SIDES, SEEDS)
def test_bilinear_look_ups_return_pixels_at_their_centers_and_stay_in_range(width, height, seed):
    rng = np.random.default_rng(seed)
    image = rng.random((height, width, 3))
    np.testing.assert_allclose(bilinear(image, pixel_centers(width, height)), image, atol=1e-12)
    anywhere = bilinear(image[..., 0], rng.normal(size=(50, 2)) * 1e3)
    assert (anywhere >= image[..., 0].min() - 1e-12).all() and (anywhere <= image[..., 0].max() + 1e-12).all()


@given(SIDES, SIDES, SEEDS)
def test_expected_depth_is_the_depth_of_what_is_drawn(width, height, seed):
    rng = np.random.default_rng(seed)
    alpha = rng.choice([0.0, 1e-3, 0.5, 0.9, 1.0], (height, width))
    found = expected_depth(alpha * 70, alpha)
    assert np.isfinite(found).all() and (found[alpha < 0.5] == 0).all()
    np.testing.assert_allclose(found[alpha >= 0.5], 70, rtol=1e-6)


@given(SEEDS, st.sampled_from([1e-20, 1.0, 1e20]))
def test_quaternions_of_any_length_are_rotations(seed, length):
    quats = np.random.default_rng(seed).normal(size=(5, 4)) * length
    rotations = quaternion_to_matrix(quats)
    np.testing.assert_allclose(rotations @ rotations.swapaxes(-1, -2), np.tile(np.eye(3), (5, 1, 1)), atol=1e-9)
    np.testing.assert_allclose(np.linalg.det(rotations), 1, atol=1e-9)


@examples(60)
@given(
    st.lists(st.lists(st.one_of(st.floats(), st.sampled_from([0.0, 1.0])), min_size=3, max_size=3), max_size=30),
    st.booleans(),
)
def test_the_curve_is_a_permutation_of_any_points(points, single):
    with np.errstate(over="ignore"):
        array = np.array(points, np.float64).reshape(-1, 3).astype(np.float32 if single else np.float64)
    order = morton_order(array)
    assert order.dtype == np.int64 and np.array_equal(np.sort(order), np.arange(len(points)))


@given(SEEDS, st.integers(2, 700), st.integers(1, 9), st.sampled_from(["spread", "crowd", "grid", "one place"]))
def test_neighbors_are_those_of_the_slow_search(seed, num, k, kind):
    rng = np.random.default_rng(seed)
    points = rng.normal(size=(num, 3)) * 10.0 ** rng.uniform(-3, 3)
    if kind == "crowd":
        points[: num // 2] *= 1e-9
    elif kind == "grid":
        points = rng.integers(0, 4, (num, 3)).astype(np.float64)
    elif kind == "one place":
        points[:] = points[0]
    k = min(k, num - 1)
    indices, distances = neighbors(points, k)
    squared = ((points[:, None] - points[None]) ** 2).sum(-1)
    np.fill_diagonal(squared, np.inf)
    want = np.sort(squared, 1)[:, :k]
    np.testing.assert_allclose(distances**2, want, rtol=1e-12, atol=1e-300)
    assert (indices != np.arange(num)[:, None]).all() and (indices >= 0).all() and (indices < num).all()
    assert all(len(set(row)) == k for row in indices)


@given(SIDES, SIDES, st.integers(1, 70))
def test_a_shrunk_camera_keeps_its_field_of_view_up_to_what_was_cut_off(width, height, factor):
    view = camera(width, height)
    small = shrunk_camera(view, factor)
    assert small.width >= 1 and small.height >= 1
    assert small.width / small.fx <= view.width / view.fx * (1 + 1e-12)
    assert -small.cx / small.fx == pytest.approx(-view.cx / view.fx)


@given(st.integers(4, 60), st.floats(0, 1))
def test_splines_over_time_are_between_0_and_1_and_sum_to_1(num, time):
    weights = spline_weights(time, num)
    assert weights.shape == (num,) and ((weights >= 0) & (weights <= 1)).all()
    assert weights.sum() == pytest.approx(1)


@given(st.integers(1, 60), st.floats(0, 1))
def test_shares_of_frames_are_those_of_linear_interpolation(num, time):
    weights = frame_weights(time, num)
    assert weights.shape == (num,) and ((weights >= 0) & (weights <= 1)).all()
    np.testing.assert_allclose(weights, np.maximum(0, 1 - np.abs(time * num - np.arange(num))), atol=1e-8)
