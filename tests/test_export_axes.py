"""Axes: proper rotations, and Gaussians that look the same from the turned side."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
import torch
from export_scenes import covariances, moving_scene, random_splats
from scipy.spatial.transform import Rotation

from endoprior import render
from endoprior.export.axes import ROTATIONS, points_in_axes, rotated, splats_in_axes
from endoprior.render import sh


def test_axes_are_what_the_documentation_says():
    right, down, forward = np.eye(3)
    assert np.array_equal(points_in_axes(np.stack([right, down, forward]), "opengl"), np.diag([1.0, -1, -1]))
    lps = points_in_axes(np.stack([right, down, forward]), "lps")
    assert np.array_equal(lps, [[1, 0, 0], [0, 0, -1], [0, 1, 0]])  # left, inferior, posterior
    ras = points_in_axes(np.stack([right, down, forward]), "ras")
    assert np.array_equal(ras, lps * [-1, -1, 1])


@pytest.mark.parametrize("degree", range(4))
@pytest.mark.parametrize("seed", range(3))
def test_turned_gaussians_look_the_same_from_the_turned_side(degree, seed):
    splats, rotation = random_splats(20, degree, seed), Rotation.random(random_state=seed).as_matrix()
    seen = rotated(splats, rotation)
    # float32 coordinates below 100, coefficients below 1
    assert seen.means.numpy() == pytest.approx(splats.means.numpy() @ rotation.T, abs=2e-5)
    before = covariances(splats.quats.double().numpy(), splats.scales.double().numpy())
    after = covariances(seen.quats.double().numpy(), seen.scales.double().numpy())
    assert after == pytest.approx(rotation @ before @ rotation.T, rel=1e-4, abs=1e-5)
    directions = np.random.default_rng(seed).normal(size=(20, 3))
    directions /= np.linalg.norm(directions, axis=1, keepdims=True)
    colors = sh.colors(splats.sh.double(), torch.from_numpy(directions))
    turned_colors = sh.colors(seen.sh.double(), torch.from_numpy(directions @ rotation.T))
    torch.testing.assert_close(turned_colors, colors, rtol=0, atol=2e-6)
    if degree:
        assert not torch.allclose(sh.colors(splats.sh.double(), torch.from_numpy(directions @ rotation.T)), colors)


@pytest.mark.parametrize("name", ROTATIONS)
def test_a_turned_scene_draws_the_same_picture(name):
    scene = moving_scene(sh_degree=3)
    splats, camera = scene.at(0.3), scene.cameras[3]
    matrix = np.eye(4)
    matrix[:3, :3] = ROTATIONS[name]
    moved = replace(camera, world_to_camera=camera.world_to_camera @ matrix.T)
    rasterize = render.load("numba")
    want = rasterize(splats, camera, background=torch.zeros(3))
    got = rasterize(splats_in_axes(splats, name), moved, background=torch.zeros(3))
    torch.testing.assert_close(got.color, want.color, rtol=0, atol=1e-4)  # equal depths may change order
    torch.testing.assert_close(got.depth, want.depth, rtol=0, atol=1e-2)
