"""Every fast backend against the reference: image and gradients, with the same cotangents."""

from __future__ import annotations

from typing import get_args

import pytest
import torch
from render_scenes import agree_where_full, asks_for_one_gradient, camera, compare, one, render_with_grads, splats

from endoprior import render
from endoprior.render.constants import ALPHA_MAX

CPU = [name for name in get_args(render.Backend) if name not in render.ON_GPU]
FAST = [name for name in get_args(render.Backend) if name not in ("reference", *render.ON_GPU)]
"""Those on a GPU have files of their own."""


def test_a_fast_backend_is_under_test():
    assert FAST, "nothing to compare with the reference"


@pytest.mark.parametrize("backend", FAST)
@pytest.mark.parametrize("degree", range(4))
@pytest.mark.parametrize("depth_grad_to_means", [True, False])
def test_agrees_with_reference(backend, degree, depth_grad_to_means):
    """Rotated camera, off-center principal point, every SH degree, many Gaussians outside the image."""
    view = camera(seed=degree)
    scene = splats(view, degree=degree, seed=degree)
    want, grads = compare(backend, scene, view, depth_grad_to_means=depth_grad_to_means)
    assert want.alpha.max() > 0.9 and (want.radii == 0).any()  # the scene is not trivial
    assert all(value.abs().max() > 0 for value in grads.values())


@pytest.mark.parametrize("backend", FAST)
@pytest.mark.parametrize("width, height", [(1, 1), (16, 32), (33, 31), (70, 65), (7, 100)])
def test_agrees_at_any_size(backend, width, height):
    """Images smaller than a tile, of exactly one, and not a multiple of one."""
    view = camera(width, height, seed=1)
    scene = splats(view, 40, degree=1, seed=2, widths=(0.5, 6.0))
    compare(backend, scene, view, gradient=5e-5)  # of one pixel, large sums cancel


@pytest.mark.parametrize("backend", FAST)
def test_agrees_on_needles_and_sheets(backend):
    """Axes from 1/50 px to 30 px: the blur alone keeps them drawable.

    The sums that make the gradient of a needle's shape cancel down from length^2 to width^2, here by up to
    30^2 / 0.3 = 3000 float32 roundings.
    """
    view = camera(80, 60, seed=5)
    scene = splats(view, 40, degree=0, seed=3, widths=(0.02, 30.0))
    compare(backend, scene, view, image=2e-5, gradient=5e-4)


@pytest.mark.parametrize("backend", FAST)
def test_agrees_where_pixels_fill_up(backend):
    view = camera(40, 40, seed=2)
    want = agree_where_full(backend, splats(view, 1500, degree=0, seed=4, widths=(1.0, 8.0)), view)
    assert (want.alpha > 0.9).all() and want.alpha.max() > 0.9995


@pytest.mark.parametrize("backend", FAST)
def test_gradient_is_orthogonal_to_the_length_of_a_quaternion(backend):
    view = camera()
    scene = splats(view)
    _, grads = render_with_grads(backend, scene, view)
    along = (grads["quats"] * scene.quats).sum(-1) / scene.quats.norm(dim=-1)
    assert along.abs().max() <= 1e-5 * grads["quats"].norm(dim=-1).max()  # float32 rounding of a dot product


@pytest.mark.parametrize("backend", FAST)
def test_gradients_reach_only_what_is_asked(backend):
    asks_for_one_gradient(backend)


@pytest.mark.parametrize("backend", CPU)
def test_no_gradient_where_alpha_is_capped(backend):
    """docs/conventions.md: the published rasterizer lets it pass there, at the center of nearly opaque Gaussians."""
    view = camera(1, 1, seed=None)  # one pixel, on which the Gaussian is centered: its alpha is its opacity
    for opacity, capped in ((0.98, False), (0.995, True)):
        scene = one(view, 0.5, 0.5, 40.0, scales=torch.full((1, 3), 1e3), opacities=torch.tensor([opacity]))
        out, grads = render_with_grads(backend, scene, view)
        assert out.alpha.item() == pytest.approx(min(opacity, ALPHA_MAX), abs=1e-5)
        assert bool((grads["opacities"] == 0).all() and (grads["means2d"] == 0).all()) == capped


@pytest.mark.parametrize("backend", CPU)
def test_a_radius_is_zero_where_the_footprint_misses_the_image(backend):
    """docs/conventions.md: the published rasterizer asks for the square of 3 sigma, which reaches farther for most."""
    view = camera(seed=None)
    # 1 px, seen at 24 degrees and blurred, is 1.22 px; opacity 0.1 falls to 1/255 at 2.54 of them, 3.12 px
    for left_of_center, seen in ((3.0, True), (3.2, False), (3.6, False)):
        scene = one(view, 0.5 - left_of_center, 10.5, 40.0, opacities=torch.tensor([0.1]))
        out, grads = render_with_grads(backend, scene, view)
        assert out.radii.tolist() == [4 if seen else 0]
        assert bool((out.alpha > 0).any()) == seen == bool((grads["means2d"] != 0).any())
