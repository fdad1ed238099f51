"""The definition itself: closed forms, spherical harmonics, float64 gradcheck, properties."""

from __future__ import annotations

import numpy as np
import pytest
import torch
from render_scenes import NAMES, camera, one, render_with_grads, splats
from scipy.special import factorial, lpmv

from endoprior import render
from endoprior.core.checks import InputError
from endoprior.core.geometry import project as pinhole
from endoprior.core.types import Camera, Splats
from endoprior.render import constants, sh
from endoprior.render.projection import jacobian_limits, project, rotation_matrices
from endoprior.render.reference import rasterize

BLACK = torch.zeros(3)


def test_one_gaussian_on_a_pixel_centre():
    view = camera(seed=None)
    out = rasterize(one(view, 20.5, 10.5, 40.0, sh=torch.tensor([[[1.0, 0.0, -1.0]]])), view, background=BLACK)
    red = 0.5 + 1.0 / (2 * np.sqrt(np.pi))
    # float32 rounds opacity, color and projection once each
    assert torch.allclose(out.color[10, 20], 0.6 * torch.tensor([red, 0.5, 1 - red]).float(), atol=1e-6)
    assert torch.isclose(out.alpha[10, 20], torch.tensor(0.6), atol=1e-6)
    assert torch.isclose(out.depth[10, 20], torch.tensor(0.6 * 40), rtol=1e-6)
    assert torch.allclose(out.means2d, torch.tensor([[20.5, 10.5]]), atol=1e-5)


def test_footprint_is_the_blurred_projection():
    """One pixel to the right, alpha falls by exp(-1 / (2 (1 + blur))) and below by the focal lengths' ratio."""
    view = camera(seed=None)
    scene = one(view, 20.5, 10.5, 40.0)
    out = rasterize(scene, view, background=BLACK)
    variance_x, variance_y = 1.0 + constants.BLUR_PX2, (view.fy / view.fx) ** 2 + constants.BLUR_PX2
    # atol: the off-center view direction tilts J; it reaches the sum of squares at second order in 0.1
    assert torch.isclose(out.alpha[10, 21], torch.tensor(0.6 * np.exp(-0.5 / variance_x)).float(), rtol=2e-2)
    assert torch.isclose(out.alpha[11, 20], torch.tensor(0.6 * np.exp(-0.5 / variance_y)).float(), rtol=2e-2)


def test_projected_covariance_matches_monte_carlo():
    """Samples of the 3D Gaussian, pushed through the pinhole one by one, spread as cov2d says."""
    view = camera(seed=3)
    scene = splats(view, 1, seed=6, widths=(0.5, 1.5))
    rng = np.random.default_rng(0)
    seen = project(scene, view)
    assert 0 < seen.means2d[0, 0] < view.width and 0 < seen.means2d[0, 1] < view.height  # J is not limited here
    axes = (rotation_matrices(scene.quats)[0] * scene.scales[0]).numpy()
    points = scene.means[0].numpy() + rng.normal(size=(200_000, 3)) @ axes.T
    pixels, _ = pinhole(points, view)
    want = np.cov(pixels.T) + constants.BLUR_PX2 * np.eye(2)
    # 200,000 samples know a variance to sqrt(2 / 200000) = 0.3 %; the perspective's curvature adds about as much
    np.testing.assert_allclose(seen.cov2d[0].numpy(), want[[0, 0, 1], [0, 1, 1]], rtol=0.02, atol=0.02)
    np.testing.assert_allclose(seen.means2d[0].numpy(), pinhole(scene.means.numpy(), view)[0][0], rtol=1e-5)


def test_two_layers_composite_over():
    view = camera(seed=None)
    near, far = one(view, 20.5, 10.5, 30.0), one(view, 20.5, 10.5, 50.0, sh=torch.ones(1, 1, 3))
    both = Splats(*(torch.cat([getattr(far, name), getattr(near, name)]) for name in NAMES))  # listed far first
    out = rasterize(both, view, background=torch.tensor([1.0, 0.0, 0.0]))
    bright = 0.5 + 0.28209479
    want = 0.6 * 0.5 + 0.4 * 0.6 * bright + 0.16 * torch.tensor([1.0, 0.0, 0.0])
    assert torch.allclose(out.color[10, 20], want, atol=1e-6)
    assert torch.isclose(out.depth[10, 20], torch.tensor(0.6 * 30 + 0.24 * 50), rtol=1e-6)


def test_full_pixel_stops_before_the_gaussian_that_fills_it():
    """0.99 twice leaves exactly 1e-4, in float64 just above it or not; the third and all later ones never count."""
    view = camera(seed=None)
    layers = [one(view, 20.5, 10.5, z, opacities=torch.tensor([0.97])) for z in (30.0, 31.0, 32.0, 33.0)]
    scene = Splats(*(torch.cat([getattr(layer, name) for layer in layers]) for name in NAMES))
    out = rasterize(scene, view, background=BLACK)
    # 0.03^2 = 9e-4 is above 1e-4, 0.03^3 = 2.7e-5 is not: two layers are rendered, the third and fourth are not
    assert torch.isclose(out.alpha[10, 20], torch.tensor(1 - 0.03**2), atol=1e-6)


@pytest.mark.parametrize("degree", range(4))
def test_harmonics_are_scipys(degree):
    """Real combinations of SciPy's complex harmonics, which keep the Condon-Shortley phase."""
    rng = np.random.default_rng(degree)
    directions = rng.normal(size=(50, 3))
    directions /= np.linalg.norm(directions, axis=1, keepdims=True)
    polar, azimuth = np.arccos(directions[:, 2]), np.arctan2(directions[:, 1], directions[:, 0])
    want = []
    for l in range(degree + 1):  # noqa: E741
        for m in range(-l, l + 1):
            norm = np.sqrt((2 * l + 1) / (4 * np.pi) * factorial(l - abs(m)) / factorial(l + abs(m)))
            value = norm * lpmv(abs(m), l, np.cos(polar)) * np.exp(1j * abs(m) * azimuth)
            want.append(value.real if m == 0 else np.sqrt(2) * (value.imag if m < 0 else value.real))
    got = sh.basis(torch.tensor(directions), degree)
    np.testing.assert_allclose(got.numpy(), np.stack(want, -1), atol=1e-12)  # a few float64 roundings


@pytest.mark.parametrize("depth_grad_to_means", [True, False])
def test_gradcheck(depth_grad_to_means):
    """Float64 central differences of every output to every input, on Gaussians wide enough to avoid the cutoff.

    Ten pixels of spread on a 5x4 image keep alpha above 1/255 everywhere; opacity 0.1-0.5 keeps it below 0.99 and the
    pixels from filling up.
    """
    view = camera(5, 4)
    scene = splats(view, 3, degree=1, widths=(10.0, 14.0))
    opacities = torch.tensor([0.1, 0.3, 0.5])
    inputs = [getattr(scene, name).double() for name in NAMES]
    inputs[3] = opacities.double()
    inputs = [value.requires_grad_() for value in inputs]
    background = torch.tensor([0.3, 0.1, 0.7], dtype=torch.float64, requires_grad=True)

    def outputs(background, *values):
        out = rasterize(Splats(*values), view, background=background, depth_grad_to_means=depth_grad_to_means)
        return out.color, out.alpha, out.depth

    if depth_grad_to_means:
        assert torch.autograd.gradcheck(outputs, (background, *inputs))
    else:  # depth deliberately does not know its own z: color and alpha must still be exact
        assert torch.autograd.gradcheck(lambda *values: outputs(*values)[:2], (background, *inputs))


def test_detached_depth_is_the_same_image_with_constant_z():
    """method_facts 9.5: composited z carries no gradient, but z still gets one through the projected covariance."""
    view, names = camera(), ("means", "opacities", "scales", "sh")
    scene = splats(view)
    with_z, grads = render_with_grads("reference", scene, view)
    without, less = render_with_grads("reference", scene, view, depth_grad_to_means=False)
    assert torch.equal(with_z.depth, without.depth)
    assert all(torch.allclose(grads[name], less[name]) for name in names[1:])
    # the difference is what z alone gets: weights times the cotangent, along the camera's axis
    along = torch.tensor(view.world_to_camera[2, :3])
    gap = grads["means"] - less["means"]
    assert gap.abs().max() > 1e-2
    assert torch.allclose(gap, (gap @ along)[:, None] * along, atol=1e-10)


def test_unknown_backend_is_named():
    with pytest.raises(InputError, match="expected one of reference, numba, triton, gsplat, got 'gpu'"):
        render.load("gpu")


def test_shape_and_type_errors_name_the_field():
    view = camera()
    scene = splats(view, 3, degree=1)
    with pytest.raises(ValueError, match="quats must have shape"):
        rasterize(Splats(scene.means, scene.quats[:2], scene.scales, scene.opacities, scene.sh), view, background=BLACK)
    with pytest.raises(ValueError, match="4, 9 or 16"):
        rasterize(
            Splats(scene.means, scene.quats, scene.scales, scene.opacities, scene.sh[:, :3]), view, background=BLACK
        )
    with pytest.raises(ValueError, match="share one dtype"):
        rasterize(scene, view, background=BLACK.double())


def test_principal_point_moves_the_limits():
    """The Jacobian's limits follow the true principal point; centered, they are 1.3 tan(fov / 2)."""
    centered = Camera(100, 80, 50.0, 40.0, 50.0, 40.0, np.eye(4))
    assert jacobian_limits(centered) == pytest.approx((-1.3, 1.3, -1.3, 1.3))
    shifted = Camera(100, 80, 50.0, 40.0, 60.0, 40.0, np.eye(4))
    assert jacobian_limits(shifted) == pytest.approx((-1.5, 1.1, -1.3, 1.3))
