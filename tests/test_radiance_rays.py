"""Rays, samples along them, what they show, and the terms of the loss: closed forms, slow loops, differences."""

from __future__ import annotations

import numpy as np
import pytest
import torch
from render_scenes import camera as some_camera

from endoprior.core.geometry import pixel_centers, project
from endoprior.core.types import Camera
from endoprior_radiance import endonerf, endosurf
from endoprior_radiance.endosurf import first_crossing
from endoprior_radiance.rays import (
    Composited,
    all_rays,
    by_weight,
    centers,
    composited,
    density_alpha,
    even,
    jittered,
    rays_of,
    sphere_ends,
    surface_alpha,
    surface_places,
    to_perspective,
)
from endoprior_radiance.trainer import due, refined


def test_rays_pass_the_pixel_centers():
    camera = some_camera()
    rays = all_rays(camera)
    z = torch.full((len(rays), 1), 40.0)
    pixels, depth = project(rays.at(z)[:, 0].double().numpy(), camera)
    np.testing.assert_allclose(pixels, pixel_centers(camera.width, camera.height).reshape(-1, 2), atol=1e-3)
    np.testing.assert_allclose(depth, 40, atol=1e-4)
    np.testing.assert_allclose(rays.units.norm(dim=1).numpy(), 1, atol=1e-6)
    chosen = rays_of(camera, np.array([3 * camera.width + 5]))
    torch.testing.assert_close(chosen.directions[0], rays.directions[3 * camera.width + 5])


def test_perspective_space_is_ndc_of_the_static_camera():
    """x and y as in NeRF's normalized device coordinates; depth linear in z, 2 t - 1 for z = 2 t scale."""
    camera, scale, near, t = Camera(64, 48, 60.0, 50.0, 32.0, 24.0, np.eye(4)), 30.0, 1.0, 0.35
    rays = all_rays(camera)
    slopes = torch.tensor([2 * camera.fx / camera.width, 2 * camera.fy / camera.height])
    found = to_perspective(rays.at(torch.full((len(rays), 1), 2 * t * scale))[:, 0], slopes, scale)
    x, y = pixel_centers(64, 48).reshape(-1, 2).T
    np.testing.assert_allclose(found[:, 0], 2 * (x / 64) - 1, atol=1e-6)
    np.testing.assert_allclose(found[:, 1], 2 * (y / 48) - 1, atol=1e-6)
    np.testing.assert_allclose(found[:, 2], 2 * t - 1, atol=1e-6)
    on_plane = rays.directions * near  # NeRF's ray from the near plane: origin and direction in its coordinates
    start = torch.cat([slopes * on_plane[:, :2] / on_plane[:, 2:], 1 - 2 * near / on_plane[:, 2:]], -1)
    direction = torch.tensor([0.0, 0.0, 2.0])  # of a camera at the origin: its length doubles t
    torch.testing.assert_close(start + t * direction, found, rtol=0, atol=1e-5)


def test_perspective_space_is_finite_in_the_plane_of_the_camera():
    assert bool(to_perspective(torch.zeros(1, 3), torch.tensor([1.7, 2.1]), 40.0).isfinite().all())


def test_jitter_stays_between_the_middles():
    values = torch.tensor([[0.0, 1.0, 4.0]])
    assert jittered(values, torch.zeros(1, 3)).tolist() == [[0.0, 0.5, 2.5]]
    assert jittered(values, torch.ones(1, 3)).tolist() == [[0.5, 2.5, 4.0]]
    assert jittered(values, None) is values


def test_samples_follow_the_weights():
    edges = torch.tensor([[0.0, 1.0, 2.0, 4.0]])
    places = torch.rand(1, 100_000, generator=torch.Generator().manual_seed(0))
    found = by_weight(edges, torch.tensor([[1.0, 0.0, 3.0]]), places)[0]
    shares = torch.histc(found, 4, 0, 4) / len(found)
    np.testing.assert_allclose(shares, [0.25, 0, 0.375, 0.375], atol=0.01)
    ordered = by_weight(edges, torch.zeros(1, 3), centers(9, 1, torch.device("cpu")))[0]  # no weights: even
    assert bool((ordered.diff() > 0).all()) and 0 < float(ordered[0]) and float(ordered[-1]) < 4


@pytest.mark.parametrize("place", [0.0, 1.0])
def test_samples_at_the_ends_are_finite(place: float):
    found = by_weight(torch.tensor([[1.0, 2.0, 3.0]]), torch.tensor([[0.0, 0.0]]), torch.full((1, 2), place))
    np.testing.assert_allclose(found, 1 + 2 * place)


def test_ends_in_the_sphere():
    origins = torch.tensor([[0.0, 0, -3], [0.0, 2, -3], [0.0, 0, 0]])
    near, far = sphere_ends(origins, torch.tensor([[0.0, 0, 1]] * 3))
    np.testing.assert_allclose(near, [2, 3, 0])
    np.testing.assert_allclose(far, [4, 3, 1])


def slow_blend(alpha: list[float], color: list[list[float]], depth: list[float]) -> tuple[list[float], float, float]:
    total, through, mean = [0.0, 0.0, 0.0], 1.0, 0.0
    for a, c, z in zip(alpha, color, depth, strict=True):
        for k in range(3):
            total[k] += through * a * c[k]
        mean += through * a * z
        through *= 1 - a
    return total, mean, 1 - through


def test_blending_against_a_loop():
    rng = np.random.default_rng(0)
    alpha, color, depth = rng.random((4, 9)), rng.random((4, 9, 3)), np.sort(rng.random((4, 9)))
    found = composited(*map(torch.from_numpy, (alpha, color, depth)))
    for k in range(4):
        total, mean, cover = slow_blend(alpha[k].tolist(), color[k].tolist(), depth[k].tolist())
        np.testing.assert_allclose(found.color[k], total, atol=1e-5)  # 1e-7 is added to what passes a sample
        np.testing.assert_allclose([found.depth[k], found.alpha[k]], [mean, cover], atol=1e-5)


def test_alpha_of_density():
    found = density_alpha(torch.tensor([[2.0, -1.0, 0.5]]), torch.tensor([[0.0, 0.1, 0.4]]))
    np.testing.assert_allclose(found[0], [1 - np.exp(-0.2), 0, 1], atol=1e-6)


def test_alpha_of_a_surface():
    """A step of 0.2 head on through distance 0: from +0.1 to -0.1."""
    found = surface_alpha(*(torch.tensor([[v]]) for v in (0.0, -1.0, 0.2)), torch.tensor(20.0), 1.0)
    enter, leave = 1 / (1 + np.exp(-2)), 1 / (1 + np.exp(2))
    np.testing.assert_allclose(found, (enter - leave) / enter, atol=1e-5)
    away = surface_alpha(*(torch.tensor([[v]]) for v in (0.0, 0.8, 0.2)), torch.tensor(20.0), 1.0)
    assert float(away) < 1e-4  # a surface that faces away does not show ...
    assert float(surface_alpha(*(torch.tensor([[v]]) for v in (0.0, 0.8, 0.2)), torch.tensor(20.0), 0.0)) > 0.1  # yet


@pytest.mark.parametrize("anneal", [0.0, 0.4, 1.0])
def test_gradients_of_the_alpha_of_a_surface(anneal: float):
    rng = np.random.default_rng(1)
    distance, slope, step = (
        torch.from_numpy(rng.uniform(*ends, (3, 5))) for ends in ((-0.1, 0.1), (-1, -0.2), (0.05, 0.2))
    )
    sharpness = torch.tensor(20.0, dtype=torch.float64)
    inputs = [value.requires_grad_() for value in (distance, slope, step, sharpness)]
    assert torch.autograd.gradcheck(lambda *values: surface_alpha(*values, anneal), inputs)


def test_places_of_a_surface_are_where_it_is():
    s = even(torch.zeros(1), torch.ones(1) * 2, 21)
    weights = surface_places(s, 1.23 - s, torch.ones(1, 21, dtype=torch.bool), 64.0)[0]
    assert int(weights.argmax()) == 12
    outside = torch.zeros(1, 21, dtype=torch.bool)  # nothing is there, whatever the distance says
    assert float(surface_places(s, 1.23 - s, outside, 64.0)[0, :11].max()) < 1e-3


def test_rays_enter_a_sphere():
    origins = torch.tensor([[0.0, 0, -3], [0.3, 0, -3], [0.0, 0.9, -3]])
    units = torch.tensor([[0.0, 0, 1]] * 3)
    found = first_crossing(lambda points: points.norm(dim=-1) - 0.5, origins, units)
    np.testing.assert_allclose(found, [[0, 0, -0.5], [0.3, 0, -0.4]], atol=1e-4)
    assert first_crossing(lambda points: points.norm(dim=-1) + 1, origins, units).shape == (0, 3)


def a_view(depth: list[float], alpha: list[float]) -> Composited:
    color = torch.tensor([[0.5, 0.5, 0.5]] * len(depth))
    return Composited(color, torch.tensor(depth), torch.tensor(alpha), torch.empty(0))


def test_loss_of_endonerf_by_hand():
    target = torch.tensor([[0.5, 0.5, 0.2], [0.5, 0.5, 0.5], [0.5, 0.5, 0.5]])
    depth, measured = torch.tensor([0.6, 1.0, torch.nan]), torch.tensor([True, True, False])
    found = endonerf.loss_terms(a_view([0.5, 0.3, 1.0], [1.0, 0.5, 1.0]), target, depth, measured)
    assert float(found["color"]) == pytest.approx(0.09 / 9)
    near, far = 0.5 * 0.1**2, 0.2 * (0.4 - 0.1)  # Huber's two branches
    assert float(found["depth"]) == pytest.approx((near + far) / 2, rel=1e-4)


def test_no_measured_depth_costs_nothing():
    view = a_view([0.5], [0.0])
    found = endonerf.loss_terms(view, torch.zeros(1, 3), torch.zeros(1), torch.tensor([False]))
    assert float(found["depth"]) == 0
    none = torch.tensor([False])
    assert float(endosurf.depth_term(torch.tensor([torch.nan]), torch.zeros(1), none)) == 0
    assert float(endosurf.neighbor_term(torch.zeros(0, 3), torch.zeros(0, 3))) == 0


def test_loss_of_endosurf_by_hand():
    color, target = torch.tensor([[0.1, 0.2, 0.3], [0.0, 0, 0]]), torch.tensor([[0.2, 0.2, 0.1], [0.5, 0, 0]])
    assert float(endosurf.EndoSurf.color_term(color, target)) == pytest.approx((0.3 + 0.5) / 2)
    counted = torch.tensor([True, False, True])
    assert float(endosurf.depth_term(torch.tensor([1.0, 9, 2]), torch.ones(3), counted)) == pytest.approx(0.5)
    terms = endosurf.surface_terms(torch.tensor([-0.2, 9, 0.4]), torch.tensor([-1.0, 9, 0.5]), counted)
    assert float(terms["surface"]) == pytest.approx(0.3)
    assert float(terms["angle"]) == pytest.approx(0.1 * 0.25)
    gradients = torch.tensor([[2.0, 0, 0], [0, 1, 0], [0, 0, 5]])
    assert float(endosurf.eikonal_term(gradients, torch.tensor([0.5, 1.0, 1.3]))) == pytest.approx(0.1 * 0.5)
    beside = torch.tensor([[0.0, 3, 0], [0, 2, 0]])
    assert float(endosurf.neighbor_term(gradients[:2], beside)) == pytest.approx(0.1 * 2**0.5 / 2, rel=1e-4)


def test_refinement_takes_the_worst_tenth():
    measured, rendered = torch.full((2, 10), 10.0), torch.full((2, 10), 10.0)
    rendered[0, 3], rendered[1, 7], rendered[1, 9] = 14.0, 7.0, 90.0
    tissue = torch.ones(2, 10, dtype=torch.bool)
    tissue[1, 9] = False
    found = refined(measured, rendered, tissue)
    assert (float(found[0, 3]), float(found[1, 7]), float(found[1, 9])) == (14.0, 7.0, 10.0)
    assert int((found != 10).sum()) == 2
    assert torch.equal(refined(measured, measured, tissue), measured)


def test_refinement_is_due_four_times():
    assert [i for i in range(1, 40_001) if due(i, 4000)] == [4000, 8000, 12000, 16000]
    assert not any(due(i, 0) for i in range(100))
