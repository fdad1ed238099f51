"""The Numba backend on its own: central differences, determinism, invariance, poison, and what its tiles may skip."""

from __future__ import annotations

from dataclasses import replace

import numba
import numpy as np
import pytest
import torch
from numba import njit
from render_scenes import NAMES, camera, one, only_background, poison, render_with_grads, splats
from scipy.spatial.transform import Rotation

from endoprior.compute import simd
from endoprior.core.types import Splats
from endoprior.render import constants
from endoprior.render.numba import rasterize, tiles
from endoprior.render.numba.composite import blend

BACKGROUND = torch.tensor([0.1, 0.2, 0.3])


def identical(first, second):
    """Whether two renderings are bit-identical, gradients included."""
    images = all(torch.equal(getattr(first[0], n), getattr(second[0], n)) for n in ("color", "alpha", "depth", "radii"))
    return images and all(torch.equal(first[1][n], second[1][n]) for n in first[1])


def test_bit_identical_for_any_number_of_threads():
    view = camera(100, 90)
    scene = splats(view, 400, widths=(0.5, 20.0))
    threads = numba.get_num_threads()
    rendered = []
    try:
        for count in (1, threads, 1, threads):
            numba.set_num_threads(count)
            rendered.append(render_with_grads("numba", scene, view))
    finally:
        numba.set_num_threads(threads)
    assert all(identical(rendered[0], other) for other in rendered[1:])


def test_ties_in_depth_keep_their_order():
    view = camera(seed=None)
    layers = [one(view, 20.5, 10.5, 40.0, sh=torch.full((1, 1, 3), value)) for value in (1.0, -1.0)]
    for first, second in (layers, layers[::-1]):
        both = Splats(*(torch.cat([getattr(first, name), getattr(second, name)]) for name in NAMES))
        color = rasterize(both, view, background=torch.zeros(3)).color[10, 20, 0]
        bright = 0.5 + 0.28209479 * float(first.sh[0, 0, 0])
        assert abs(color - (0.6 * bright + 0.24 * (1 - bright))) < 1e-6


def test_moving_scene_and_camera_together_changes_nothing():
    """Degree 0: color does not turn with the world. World coordinates round in float32, about 1e-6 of 60 mm."""
    view = camera()
    scene = splats(view, degree=0)
    turn = Rotation.from_rotvec([0.3, -0.5, 0.2])
    shift = np.array([4.0, -7.0, 2.0])
    w, x, y, z = np.roll(turn.as_quat(), 1)
    left_multiply = torch.tensor([[w, -x, -y, -z], [x, w, -z, y], [y, z, w, -x], [z, -y, x, w]]).float()
    motion = np.eye(4)
    motion[:3, :3], motion[:3, 3] = turn.as_matrix(), shift
    moved = replace(
        scene,
        means=scene.means @ torch.tensor(turn.as_matrix().T).float() + torch.tensor(shift).float(),
        quats=scene.quats @ left_multiply.T,
    )
    want = rasterize(scene, view, background=BACKGROUND)
    there = replace(view, world_to_camera=view.world_to_camera @ np.linalg.inv(motion))
    got = rasterize(moved, there, background=BACKGROUND)
    assert (got.color - want.color).abs().max() < 1e-4  # 1e-5 px of displacement at slopes of up to 1 per px


def test_central_differences():
    """Directional derivatives, away from every cutoff: see `test_gradcheck` of the reference for why it is away."""
    view = camera(20, 16)
    scene = splats(view, 5, widths=(12.0, 20.0))  # weak colors stay above the cutoff at 0
    scene = replace(scene, opacities=torch.tensor([0.1, 0.2, 0.3, 0.4, 0.5]), sh=0.2 * scene.sh)
    _, grads = render_with_grads("numba", scene, view)
    generator = torch.Generator().manual_seed(0)
    weights = [torch.randn(s, generator=generator).double() for s in ((16, 20, 3), (16, 20), (16, 20))]
    steps = {"means": 0.05, "quats": 0.02, "scales": 0.02, "opacities": 0.01, "sh": 0.05}

    def loss(moved):
        out = rasterize(moved, view, background=BACKGROUND)
        return sum((w * v.double()).sum() for w, v in zip(weights, (out.color, out.depth, out.alpha), strict=True))

    for name, step in steps.items():
        value = getattr(scene, name)
        direction = torch.randn(value.shape, generator=generator)
        ends = [loss(replace(scene, **{name: value + sign * step * direction})) for sign in (1, -1)]
        slope = float((ends[0] - ends[1]) / (2 * step))
        want = float((grads[name].double() * direction).sum())
        # float32 rounding of a sum near 1e3 over the step, and the third derivative times step^2
        assert slope == pytest.approx(want, rel=5e-3, abs=2e-2), name


@pytest.mark.parametrize("name", ["means", "quats", "scales"])
@pytest.mark.parametrize("backend", ["numba", "reference"])
def test_numbers_whose_squares_overflow_give_finite_images_and_gradients(backend, name):
    """What is no number is in `test_properties_render`."""
    view = camera(24, 20)
    out, grads = render_with_grads(backend, poison(splats(view, 12), name, 5, 1e38), view, dtype=torch.float32)
    assert all(torch.isfinite(image).all() for image in (out.color, out.alpha, out.depth, out.means2d))
    assert all(torch.isfinite(grad).all() for grad in grads.values())


@pytest.mark.parametrize("backend", ["numba", "reference"])
def test_zero_quaternion_behind_and_tiny_are_culled_or_finite(backend):
    view = camera(24, 20, seed=None)
    scene = splats(view, 6)
    scene.quats[0] = 0
    scene.means[1, 2] = -40
    scene.means[2, 2] = 0.99 * constants.NEAR_Z
    scene.scales[3] = 1e-30
    scene.opacities[4] = 1e-3
    out, grads = render_with_grads(backend, scene, view, dtype=torch.float32)
    assert (out.radii[[0, 1, 2, 4]] == 0).all()
    assert torch.isfinite(out.color).all() and all(torch.isfinite(grad).all() for grad in grads.values())


def test_huge_gaussians_cover_everything():
    """A standard deviation of 10,000 px: alpha is the opacity at every pixel."""
    view = camera(seed=None)
    scene = one(view, 20.5, 10.5, 40.0, scales=torch.full((1, 3), 1e4 * 40 / view.fx))
    out = rasterize(scene, view, background=BACKGROUND)
    assert torch.allclose(out.alpha, torch.tensor(0.6), atol=1e-4)  # 50 px are 0.005 sigma


@pytest.mark.parametrize("num", [0, 3])
@pytest.mark.parametrize("backend", ["numba", "reference"])
def test_without_visible_gaussians_the_image_is_the_background(backend, num):
    only_background(backend, num)


def test_other_types_are_rejected():
    view = camera()
    scene = splats(view, 2)
    doubled = Splats(*(getattr(scene, name).double() for name in NAMES))
    with pytest.raises(ValueError, match=r"float32 on one cpu device; got torch\.float64"):
        rasterize(doubled, view, background=BACKGROUND.double())


def test_an_image_needs_no_gradient():
    view = camera()
    with torch.no_grad():
        out = rasterize(splats(view), view, background=BACKGROUND)
    assert not out.color.requires_grad


def test_tiles_skip_only_what_is_not_rendered():
    """Slow loop: every pixel whose alpha reaches ALPHA_MIN lies in the listed rows of its strip, for every Gaussian.

    And not much more is listed: on average at most two rows per strip beyond the rendered ones.
    """
    rng = np.random.default_rng(0)
    width, height, num = 75, 70, 120
    centers = rng.uniform(-20, 95, (num, 2)).astype(np.float32)
    a = np.exp(rng.uniform(-5, 1, num))
    k, m = rng.normal(size=num) * 2, np.exp(rng.uniform(-7, 1, num))
    conic_ldl = np.stack([a, k, m], -1).astype(np.float32)
    opacities = rng.uniform(0.005, 0.99, num).astype(np.float32)
    z, colors = rng.uniform(1, 2, num).astype(np.float32), np.zeros((num, 3), np.float32)
    slopes = np.zeros((num, 2, 3), np.float32)
    lists = tiles.build(centers, conic_ldl, z, colors, slopes, opacities, np.ones(num, np.int32), width, height)
    x, y = np.meshgrid(np.arange(width) + 0.5, np.arange(height) + 0.5)
    tiles_x = -(-width // tiles.TILE_WIDTH)
    listed = np.zeros((num, height, width), bool)
    for tile in range(len(lists.tile_starts) - 1):
        pairs = lists.pairs[lists.tile_starts[tile] : lists.tile_starts[tile + 1]]
        assert (np.diff(z[pairs[:, tiles.ID]]) > 0).all()
        for pair in pairs:
            for strip in range(tiles.STRIPS):
                first, end = pair[tiles.FIRST_ROWS + 2 * strip : tiles.FIRST_ROWS + 2 * strip + 2]
                top = tile // tiles_x * tiles.TILE_HEIGHT
                left = tile % tiles_x * tiles.TILE_WIDTH + strip * simd.LANES
                listed[pair[tiles.ID], top + first : top + max(end, first), left : left + simd.LANES] = True
    extra = 0
    for g in range(num):
        u = x - centers[g, 0] + k[g] * (y - centers[g, 1])
        alpha = opacities[g] * np.exp(-0.5 * (a[g] * u**2 + m[g] * (y - centers[g, 1]) ** 2))
        rendered = alpha >= constants.ALPHA_MIN
        assert not (rendered & ~listed[g]).any()
        strips = [slice(s, s + simd.LANES) for s in range(0, width, simd.LANES)]
        extra += sum(int((listed[g][:, s].any(1) & ~rendered[:, s].any(1)).sum()) for s in strips)
    num_strips = sum((listed[:, :, s : s + simd.LANES].any((1, 2))).sum() for s in range(0, width, simd.LANES))
    assert extra <= 2 * num_strips
    slots = np.sort(lists.pairs[:, tiles.SLOT])
    assert np.array_equal(slots, np.arange(len(slots))) and lists.slot_starts[-1] == len(slots)


@njit
def _alphas(exponents, out):
    for i in range(0, exponents.size, simd.LANES):
        alpha, _, _ = blend(simd.load(exponents, i), simd.broadcast(np.float32(1.0)))
        simd.store(out, i, alpha)


def test_alpha_is_a_power_of_two_to_one_part_in_a_million():
    exponents = np.linspace(np.log2(1 / 255), 0.0, 4096).astype(np.float32)[8:]
    exponents = exponents[: exponents.size // simd.LANES * simd.LANES]
    out = np.empty_like(exponents)
    _alphas(exponents, out)
    want = np.minimum(2.0 ** exponents.astype(np.float64), np.float32(constants.ALPHA_MAX))
    assert np.abs(out / want - 1).max() < 5e-7
    outside = np.array([-8.0, -130.0, -1e30, -np.inf] * (simd.LANES // 4), np.float32)
    _alphas(outside, out[: simd.LANES])
    assert (out[: simd.LANES] == 0).all()
