"""Both renderers on generated scenes: extreme numbers, poison, invariances, and agreement with each other."""

from __future__ import annotations

import math
from dataclasses import replace

import numpy as np
import pytest
import torch
from hypothesis import assume, given
from hypothesis import strategies as st
from hypothesis_profiles import examples
from render_scenes import NAMES, camera, pick, render_with_grads, splats

from endoprior.core.types import Camera, Splats
from endoprior.render.constants import ALPHA_MIN, MIN_QUAT, NEAR_Z

BACKENDS = ("numba", "reference")
WEIRD = (math.nan, math.inf, -math.inf)
SEEDS = st.integers(0, 2**31 - 1)


@st.composite
def views(draw_from):
    """A camera of any small image, 1x1 included, at the origin or anywhere."""
    width, height = (draw_from(st.one_of(st.integers(1, 4), st.integers(5, 70))) for _ in range(2))
    return camera(width, height, seed=draw_from(st.one_of(st.none(), st.integers(0, 99))))


@st.composite
def scenes(draw_from, most=12):
    """A camera, and Gaussians of ordinary size around its image."""
    view = draw_from(views())
    num, degree = draw_from(st.integers(0, most)), draw_from(st.integers(0, 3))
    return view, splats(
        view, num, degree, draw_from(SEEDS), widths=draw_from(st.sampled_from([(0.2, 4.0), (1.0, 40.0)]))
    )


@st.composite
def wild_scenes(draw_from):
    """The same with numbers over most of float32's range in some fields, and opacities at their limits."""
    view, scene = draw_from(scenes())
    rng, num = np.random.default_rng(draw_from(SEEDS)), len(scene)

    def spread(low, high, shape):
        return torch.tensor(10.0 ** rng.uniform(low, high, shape), dtype=torch.float32)

    changes = {}
    wild = draw_from(st.sets(st.sampled_from(["scales", "quats", "means", "near", "opacities"]), min_size=1))
    if "scales" in wild:
        changes["scales"] = spread(-20, 20, (num, 3))
    if "quats" in wild:
        changes["quats"] = scene.quats * spread(-45, 38, (num, 1)) * (torch.rand(num, 1) > 0.1)
    if "means" in wild:
        changes["means"] = torch.tensor(rng.normal(size=(num, 3)), dtype=torch.float32) * spread(-10, 20, (num, 1))
    if "near" in wild:  # at, behind, and a hair in front of the near plane and of the camera
        z = rng.choice([-40.0, -NEAR_Z, 0.0, 1e-30, 0.99 * NEAR_Z, NEAR_Z, 1.0000001 * NEAR_Z, 1.01 * NEAR_Z], num)
        there = np.stack([rng.normal(size=num) * 0.1, rng.normal(size=num) * 0.1, z], -1)
        to_world = np.linalg.inv(view.world_to_camera)
        changes["means"] = torch.tensor(there @ to_world[:3, :3].T + to_world[:3, 3], dtype=torch.float32)
    if "opacities" in wild:
        values = [0.0, 1.0, ALPHA_MIN, 0.99 * ALPHA_MIN, 1 - 1e-7, 1e-30, 0.5]
        changes["opacities"] = torch.tensor(rng.choice(values, num), dtype=torch.float32)
    return view, replace(scene, **changes)


def assert_sound(out, grads, scene, view):
    """All finite; alpha, color and depth mix what was rendered; what was culled gets no gradient."""
    assert all(torch.isfinite(image).all() for image in (out.color, out.alpha, out.depth, out.means2d))
    bad = [name for name, grad in grads.items() if not torch.isfinite(grad).all()]
    assert not bad, bad
    assert out.alpha.shape == (view.height, view.width)
    assert (out.alpha >= 0).all() and (out.alpha <= 1).all()
    rendered = out.radii > 0
    if not rendered.any():
        assert (out.alpha == 0).all() and (out.depth == 0).all()
        assert torch.equal(out.color, torch.tensor([0.1, 0.2, 0.3]).expand_as(out.color))
        return
    means = scene.means[rendered].double()
    z = means @ torch.tensor(view.world_to_camera[2, :3]) + view.world_to_camera[2, 3]
    slack = 1e-4 * out.alpha.double() + 1e-6  # float32 sums
    assert (out.depth <= out.alpha * z.max() * (1 + 1e-4) + slack * z.max()).all()
    assert (out.depth >= out.alpha * z.min() * (1 - 1e-4) - slack * z.max()).all()
    assert (out.color >= 0).all() or scene.color_slopes.any()  # a color that changes linearly may pass 0
    culled = ~rendered
    for name in NAMES:
        assert (grads[name][culled] == 0).all(), name


@pytest.mark.parametrize("backend", BACKENDS)
@examples(80)
@given(wild_scenes())
def test_extreme_numbers_give_finite_images_and_gradients(backend, made):
    view, scene = made
    out, grads = render_with_grads(backend, scene, view, dtype=torch.float32)
    assert_sound(out, grads, scene, view)


@pytest.mark.parametrize("backend", BACKENDS)
@given(scenes(), st.sampled_from(NAMES), st.sampled_from(WEIRD), SEEDS, st.booleans())
def test_one_number_that_is_none_poisons_nothing(backend, made, name, value, place, whole):
    """A Gaussian with NaN or infinity in one of its numbers, or in all of a field, is as if it were not there."""
    view, scene = made
    assume(len(scene))
    row = place % len(scene)
    field = getattr(scene, name).clone()
    if whole:
        field[row] = value
    else:
        field[row].view(-1)[place // len(scene) % field[row].numel()] = value
    out, grads = render_with_grads(backend, replace(scene, **{name: field}), view, dtype=torch.float32)
    others = torch.tensor([i for i in range(len(scene)) if i != row], dtype=torch.int64)
    want, want_grads = render_with_grads(backend, pick(scene, others), view, dtype=torch.float32)
    assert out.radii[row] == 0
    assert all(torch.equal(getattr(out, image), getattr(want, image)) for image in ("color", "alpha", "depth"))
    for field_name in NAMES:
        assert (grads[field_name][row] == 0).all()
        assert torch.equal(grads[field_name][others], want_grads[field_name])


@pytest.mark.parametrize("backend", BACKENDS)
@given(st.floats(-45, 38), SEEDS)
def test_length_of_a_quaternion_never_matters_above_the_limit(backend, exponent, seed):
    view = camera(12, 9)
    scene = splats(view, 6, 1, seed, widths=(1.0, 6.0))
    unit = scene.quats / scene.quats.norm(dim=-1, keepdim=True)
    factor = 10.0**exponent
    out, grads = render_with_grads(backend, replace(scene, quats=unit * factor), view, dtype=torch.float32)
    want, _ = render_with_grads(backend, replace(scene, quats=unit), view, dtype=torch.float32)
    assert all(torch.isfinite(grad).all() for grad in grads.values())
    if factor >= 1.001 * MIN_QUAT:
        assert (out.color - want.color).abs().max() < 1e-4  # rounding of the scaled quaternion
    elif factor < 0.999 * MIN_QUAT:
        assert (out.radii == 0).all()


@given(scenes(most=40))
def test_fast_renderer_agrees_with_the_reference(made):
    """Up to rounding, which may decide otherwise where alpha is at ALPHA_MIN or a pixel about to be full."""
    view, scene = made
    want, want_grads = render_with_grads("reference", scene, view)
    got, grads = render_with_grads("numba", scene, view)
    gap = (got.alpha - want.alpha).abs()
    assert gap.max() <= 0.011, "more than one decision differs"
    assert (gap > 1e-5).float().mean() <= 0.01 + 1 / gap.numel()
    assert (got.radii - want.radii).abs().max() <= 1 if len(scene) else True
    if gap.max() < 1e-6:
        for name, value in want_grads.items():
            # What lies behind a pixel is known to 1e-7 of depths near 50, and counts 1 / (1 - alpha) <= 100 times.
            assert (grads[name] - value).norm() <= 0.01 * value.norm() + 0.01, name


@examples(40)
@given(wild_scenes())
def test_fast_renderer_culls_and_renders_what_the_reference_does(made):
    view, scene = made
    want, _ = render_with_grads("reference", scene, view)
    got, _ = render_with_grads("numba", scene, view)
    # Where a footprint ends within rounding of a pixel, either may see it; then it adds nothing to the image.
    differs = (got.radii > 0) != (want.radii > 0)
    assert differs.float().mean() <= 0.2 if len(scene) else True
    assert ((got.alpha - want.alpha).abs() <= 0.011).all()


@pytest.mark.parametrize("backend", BACKENDS)
@given(scenes(), SEEDS)
def test_order_of_the_gaussians_never_matters(backend, made, seed):
    view, scene = made
    order = torch.randperm(len(scene), generator=torch.Generator().manual_seed(seed))
    want, want_grads = render_with_grads(backend, scene, view, dtype=torch.float32)
    got, grads = render_with_grads(backend, pick(scene, order), view, dtype=torch.float32)
    exact = backend == "numba"
    for name in ("color", "alpha", "depth"):
        a, b = getattr(got, name), getattr(want, name)
        assert torch.equal(a, b) if exact else torch.allclose(a, b, rtol=1e-5, atol=1e-5)
    for name in NAMES if exact else ():
        assert torch.equal(grads[name], want_grads[name][order]), name


@pytest.mark.parametrize("backend", BACKENDS)
@given(wild_scenes())
def test_background_shows_by_what_alpha_leaves(backend, made):
    view, scene = made
    dark, _ = render_with_grads(backend, scene, view, background=(0.0, 0.0, 0.0), dtype=torch.float32)
    light, _ = render_with_grads(backend, scene, view, background=(1.0, 0.5, 0.25), dtype=torch.float32)
    want = (1 - dark.alpha)[..., None] * torch.tensor([1.0, 0.5, 0.25])
    assert torch.equal(dark.alpha, light.alpha)
    assert ((light.color - dark.color) - want).abs().max() <= 1e-6 * (1 + dark.color.abs().max())


@pytest.mark.parametrize("opacity", [0.004, 0.5, 1.0])
def test_a_hundred_thousand_gaussians_on_one_pixel(opacity):
    view = camera(1, 1, seed=None)
    num = 100_000
    rng = np.random.default_rng(0)
    z = torch.tensor(rng.uniform(1, 100, num), dtype=torch.float32)
    means = torch.stack([(0.5 - view.cx) / view.fx * z, (0.5 - view.cy) / view.fy * z, z], -1)
    scene = Splats(
        means,
        torch.tensor([[1.0, 0.0, 0.0, 0.0]]).repeat(num, 1),
        torch.full((num, 3), 0.5),
        torch.full((num,), opacity),
        torch.zeros(num, 1, 3),
        torch.zeros(num, 2, 3),
    )
    out, grads = render_with_grads("numba", scene, view)
    assert_sound(out, grads, scene, view)
    assert out.alpha.item() > 0.99 and out.depth.item() < (100 if opacity < 0.1 else 2)


@given(st.floats(-1, 1), st.floats(-1, 1), st.sampled_from([1.0, -1.0]))
def test_what_is_not_beyond_the_near_plane_is_culled(x, y, sign):
    view = Camera(9, 7, 8.0, 9.0, 4.0, 3.0, np.eye(4))
    base = splats(view, 1, 0)
    for z in (-1e30, -1.0, 0.0, 0.5 * NEAR_Z, NEAR_Z, np.nextafter(np.float32(NEAR_Z), np.float32(1)), 0.21, 5.0):
        means = torch.tensor([[x * abs(z) * 0.3, y * abs(z) * 0.3, z]], dtype=torch.float32)
        scene = replace(base, means=means, opacities=torch.tensor([0.9]))
        out, grads = render_with_grads("numba", scene, view)
        assert (out.radii[0] > 0) == (float(means[0, 2]) > NEAR_Z)
        assert all(torch.isfinite(grad).all() for grad in grads.values())
