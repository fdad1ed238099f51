"""The Triton backend without a GPU: its kernels, interpreted on the CPU, against the reference.

Triton decides when kernels are defined whether it interprets them, so these tests need a process of their own:
`test_triton_compile.py` starts it.
"""

from __future__ import annotations

import importlib
import os
import sys
from dataclasses import replace
from subprocess import CalledProcessError

import numpy as np
import pytest
import torch
from render_scenes import (
    NAMES,
    agree_where_full,
    asks_for_one_gradient,
    camera,
    compare,
    one,
    only_background,
    pick,
    poison,
    rejects_other_types,
    render_with_grads,
    splats,
)  # fmt: skip

from endoprior import render
from endoprior.core.checks import InputError
from endoprior.core.types import Splats
from endoprior.render.constants import ALPHA_MAX, ALPHA_MIN, MIN_QUAT, NEAR_Z
from endoprior.render.projection import project
from endoprior.render.rasterization import rasterize

pytest.importorskip("triton")
if os.environ.get("TRITON_INTERPRET") != "1":
    pytest.skip("needs TRITON_INTERPRET=1; test_triton_compile.py runs it so", allow_module_level=True)

backend, tiles, projection = (
    importlib.import_module(f"endoprior.render.triton{name}") for name in ("", ".tiles", ".projection")
)
# The interpreter is NumPy, which also computes what the masks throw away.
pytestmark = pytest.mark.filterwarnings("ignore::RuntimeWarning")
CPU = torch.device("cpu")
NAN, INF = float("nan"), float("inf")


def test_the_public_rasterizer_agrees_with_reference():
    view = camera(23, 13)
    scene = splats(view, 40, degree=1)
    matrix = torch.tensor([[[view.fx, 0, view.cx], [0, view.fy, view.cy], [0, 0, 1]]])
    found = {}
    for name, dtype in (("reference", torch.float64), ("triton", torch.float32)):
        tensors = (scene.means, scene.quats, scene.scales, scene.opacities, scene.sh)
        inputs = [value.to(dtype).requires_grad_() for value in tensors]
        views = torch.tensor(view.world_to_camera, dtype=dtype)[None].requires_grad_()
        image, alpha, _ = rasterize(*inputs, views, matrix, 23, 13, sh_degree=1, render_mode="RGB+D", backend=name)
        (image.square().sum() + alpha.sum()).backward()
        found[name] = [image.detach(), *(value.grad for value in (*inputs, views))]
    for got, want in zip(found["triton"], found["reference"], strict=True):
        assert (got - want).norm() <= 1e-4 * want.norm() and want.norm() > 0


@pytest.mark.parametrize(
    ("degree", "depth_grad_to_means"), [(0, True), (1, True), (2, True), (3, True), (0, False), (3, False)]
)
def test_agrees_with_reference(degree, depth_grad_to_means):
    """Rotated camera, off-center principal point, every SH degree, many Gaussians outside the image; 2x2 tiles."""
    view = camera(23, 13, seed=degree)
    scene = splats(view, 40, degree=degree, seed=degree)
    want, grads = compare("triton", scene, view, depth_grad_to_means=depth_grad_to_means)
    assert want.alpha.max() > 0.7 and (want.radii == 0).any()
    assert all(value.abs().max() > 0 for value in grads.values())


@pytest.mark.parametrize("width, height", [(1, 1), (16, 8), (17, 9), (7, 30)])
def test_agrees_at_any_size(width, height):
    """The sums of one pixel average no rounding away: there `numba` differs by as much."""
    view = camera(width, height, seed=1)
    compare("triton", splats(view, 20, degree=1, seed=2, widths=(0.5, 6.0)), view, gradient=1e-4)


def test_agrees_on_needles_and_sheets():
    """Axes from 1/50 px to 30 px; tolerances as in `test_render_parity`."""
    view = camera(48, 30, seed=5)
    compare("triton", splats(view, 30, degree=0, seed=3, widths=(0.02, 30.0)), view, image=2e-5, gradient=5e-4)


def test_agrees_where_pixels_fill_up():
    view = camera(16, 16, seed=2)
    scene = splats(view, 300, degree=0, seed=4, widths=(2.0, 8.0))
    scene = replace(scene, opacities=scene.opacities.clamp(min=0.6))
    assert agree_where_full("triton", scene, view).alpha.min() > 0.999


def stack(view, opacities, z_step=1.0):
    """Gaussians one behind the other on one pixel center, in shapes and colors of their own."""
    parts = [one(view, 8.5, 4.5, 30 + z_step * i, opacities=torch.tensor([o])) for i, o in enumerate(opacities)]
    scene = Splats(*(torch.cat([getattr(part, name) for part in parts]) for name in NAMES))
    num, rng = len(parts), np.random.default_rng(0)
    shapes = torch.tensor(rng.uniform(0.7, 1.8, (num, 3)), dtype=torch.float32)
    quats = torch.tensor(rng.normal(size=(num, 4)), dtype=torch.float32)
    shades = torch.linspace(-1, 1, 3 * num).reshape(-1, 1, 3)
    return replace(scene, scales=scene.scales * shapes, quats=quats, sh=shades)


def test_a_pixel_stops_before_it_would_be_full():
    """0.9 four times leaves 1e-4 (less a rounding), five times 1e-5: the last ones are not rendered at the center."""
    view = camera(16, 9, seed=None)
    want, _ = compare("triton", stack(view, [0.9, 0.9, 0.89, 0.9, 0.9, 0.9]), view)
    assert want.alpha[4, 8].item() == pytest.approx(1 - 0.1**3 * 0.11, abs=1e-9)


def test_no_gradient_where_the_cap_binds():
    """At the center of an opacity of 0.995; elsewhere it has one."""
    view = camera(16, 9, seed=None)
    want, grads = compare("triton", stack(view, [0.995, 0.5]), view)
    assert 1 - want.alpha[4, 8].item() == pytest.approx((1 - ALPHA_MAX) * 0.5) and grads["opacities"].abs().min() > 0


def test_equal_depths_keep_their_order():
    view = camera(16, 9, seed=None)
    compare("triton", stack(view, [0.5, 0.6, 0.7, 0.8], z_step=0.0), view)


def test_poison_is_culled_and_carries_no_gradient():
    """Every field of a Gaussian of its own, with every value; what is left renders bit-identically without them."""
    view = camera(33, 21)
    scene = splats(view, 40, degree=1, seed=3)
    rendered = torch.nonzero(render_with_grads("reference", scene, view)[0].radii)[:, 0].tolist()
    cases = [(name, value) for name in NAMES for value in (NAN, INF, -INF, 3e38)]
    cases += [("scales", 1e30), ("quats", 0.1 * MIN_QUAT), ("means", -3e38)]
    bad, poisoned = rendered[-len(cases) :], scene
    assert len(bad) == len(cases) < len(rendered)
    for row, (name, value) in zip(bad, cases, strict=True):
        poisoned = poison(poisoned, name, row, value)
    want = render_with_grads("reference", poisoned, view)[0].radii == 0
    got, grads = render_with_grads("triton", poisoned, view)
    assert torch.equal(got.radii == 0, want)
    assert want[bad].sum() >= len(cases) - 2  # a quaternion may be as long as that, and a mean as far
    others = torch.nonzero(~want)[:, 0]
    alone, alone_grads = render_with_grads("triton", pick(poisoned, others), view)
    assert torch.equal(got.color, alone.color) and torch.equal(got.depth, alone.depth)
    for name in (*NAMES, "means2d"):
        assert grads[name].isfinite().all() and not grads[name][want].any(), name
        assert torch.equal(grads[name][others], alone_grads[name]), name


def test_near_plane():
    view = camera(16, 9, seed=None)
    at = np.float32(NEAR_Z)  # which is a hair more than NEAR_Z
    rows = torch.tensor([[0.0, 0.0, float(z)] for z in (np.nextafter(at, np.float32(0)), at, -1.0, NAN)])
    scene = pick(one(view, view.cx, view.cy, 1.0), torch.zeros(4, dtype=torch.int64))
    out = render.load("triton")(replace(scene, means=rows), view, background=torch.zeros(3))
    assert (out.radii > 0).tolist() == [False, True, False, False]


@pytest.mark.parametrize("num", [0, 3])
def test_without_visible_gaussians_the_image_is_the_background(num):
    only_background("triton", num)


def tiles_of(scene, view):
    """(L, N) how often each tile lists each Gaussian."""
    inputs = (scene.means, scene.quats, scene.scales, scene.sh, scene.color_slopes)
    *projected, radii = backend.KERNELS.project_forward(inputs, scene.opacities, view)
    lists = backend.KERNELS.bin_tiles((*projected, scene.opacities), radii, (view.width, view.height))
    listed = torch.zeros(len(lists.tile_starts) - 1, len(scene), dtype=torch.int64)
    ranks = lists.order[lists.ranks.long()]
    for tile, (start, end) in enumerate(zip(lists.tile_starts[:-1], lists.tile_starts[1:], strict=True)):
        listed[tile] += torch.bincount(ranks[start:end], minlength=len(scene))
    return listed


def test_tiles_are_those_the_footprint_touches(monkeypatch):
    """Each once: all where the reference renders something, and few others (the ellipse may pass between pixels)."""
    view = camera(70, 45, seed=3)
    scene = splats(view, 60, degree=0, seed=1, widths=(0.3, 12.0))
    listed = tiles_of(scene, view)
    touched = torch.zeros_like(listed)
    for n in range(len(scene)):
        alpha = render.load("reference")(pick(scene, torch.tensor([n])), view, background=torch.zeros(3)).alpha
        rows, columns = torch.nonzero(alpha > 0).T
        touched[(rows // tiles.TILE_HEIGHT * tiles.columns(view.width) + columns // tiles.TILE_WIDTH), n] = 1
    assert listed.max() == 1 and (listed >= touched).all()
    assert touched.sum() > 200 and (listed - touched).sum() <= 0.02 * touched.sum()
    monkeypatch.setattr(tiles, "FEW_TILES", 0)
    assert torch.equal(tiles_of(scene, view), listed)


def test_equal_input_gives_bit_identical_results():
    view = camera(23, 13)
    scene = splats(view, 40, degree=1)
    (first, first_grads), (second, second_grads) = (render_with_grads("triton", scene, view) for _ in range(2))
    assert all(torch.equal(getattr(first, n), getattr(second, n)) for n in ("color", "alpha", "depth", "means2d"))
    assert all(torch.equal(value, second_grads[name]) for name, value in first_grads.items())


def test_gradients_reach_only_what_is_asked():
    asks_for_one_gradient("triton")


def test_cameras_are_kept_by_value():
    view = camera()
    before = projection.lens_of(view, CPU)
    assert projection.lens_of(camera(), CPU) is before and len(before) == projection.LENS_SIZE.value
    view.world_to_camera[0, 3] += 1
    assert not torch.equal(projection.lens_of(view, CPU), before)


def test_other_types_and_devices_are_rejected(monkeypatch):
    rejects_other_types(backend, monkeypatch)


def test_without_triton_one_line_says_what_to_install(monkeypatch):
    monkeypatch.delitem(sys.modules, "endoprior.render.triton")
    monkeypatch.setitem(sys.modules, "triton", None)
    with pytest.raises(InputError, match=r"^backend: triton needs Triton.*endoprior doctor[^\n]*$"):
        render.load("triton")


@pytest.mark.parametrize(
    "error", [RuntimeError("Failed to find C compiler.\nPlease"), CalledProcessError(1, ["gcc"]), AssertionError()]
)
def test_a_driver_that_does_not_start_is_told_in_one_line(monkeypatch, error):
    class Failing:
        @property
        def active(self):
            raise error

    monkeypatch.setattr(backend.triton.runtime, "driver", Failing())
    monkeypatch.setattr(backend, "DEVICE", "cuda")
    monkeypatch.setattr(backend, "check_device", lambda *_: None)
    view = camera(16, 9)
    with pytest.raises(InputError, match=r"^backend: triton could not start \([^\n]+\).*endoprior doctor[^\n]*$"):
        backend.rasterize(splats(view, 3), view, background=torch.zeros(3))


def test_edge_of_a_footprint_is_alpha_min():
    """A Gaussian whose alpha is just above and just below ALPHA_MIN three pixels from its center."""
    view = camera(16, 9, seed=None)
    scene = one(view, 8.5, 4.5, 40.0)
    xx, xy, yy = project(scene, view).cov2d[0].double().tolist()
    for factor, rendered in ((1.001, True), (0.999, False)):
        opacity = ALPHA_MIN * float(np.exp(0.5 * 9 * yy / (xx * yy - xy * xy))) * factor
        scene = replace(scene, opacities=torch.tensor([opacity]))
        out = render.load("triton")(scene, view, background=torch.zeros(3))
        want = render.load("reference")(scene, view, background=torch.zeros(3))
        assert (out.alpha[4, 11] > 0) == rendered and torch.equal(out.alpha > 0, want.alpha > 0)
