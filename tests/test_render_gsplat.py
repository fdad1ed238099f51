"""The GPU backend without a GPU, on a stand-in for gsplat. What only a GPU can show is for `bench/gpu.py` to check."""

from __future__ import annotations

import sys
from dataclasses import replace

import numpy as np
import pytest
import torch
from gsplat_stand_in import NAN, forget, fully_fused_projection, loaded
from render_scenes import (
    NAMES,
    camera,
    one,
    only_background,
    pick,
    poison,
    rejects_other_types,
    render_with_grads,
    splats,
)

from endoprior import render
from endoprior.core.checks import InputError
from endoprior.render.constants import NEAR_Z


@pytest.fixture
def gsplat(monkeypatch):
    """The backend's module on the stand-in, rendering on the CPU."""
    return loaded(monkeypatch, kernels=object())


def compare(scene, view, **options):
    """Picture within 1e-4 of the reference (depth: of its largest), gradients within 1 %."""
    want, want_grads = render_with_grads("reference", scene, view, **options)
    got, grads = render_with_grads("gsplat", scene, view, **options)
    assert (got.color - want.color).abs().max() < 1e-4
    assert (got.alpha - want.alpha).abs().max() < 1e-4
    assert (got.depth - want.depth).abs().max() < 1e-4 * want.depth.abs().max().clamp(min=1)
    assert torch.equal(got.radii > 0, want.radii > 0) and got.radii.dtype == torch.int32
    assert (got.radii - want.radii).abs().max() <= 1  # ceil may fall on either side
    rendered = want.radii > 0
    assert torch.allclose(got.means2d[rendered].double(), want.means2d[rendered], atol=1e-3)
    assert got.means2d.isfinite().all()
    for name, value in want_grads.items():
        assert grads[name].shape == value.shape and grads[name].isfinite().all(), name
        assert (grads[name] - value).norm() <= 0.01 * value.norm() + 1e-9, name
    return got, grads


def below_the_cap(scene):
    """Opacities for which 0.99 and 0.999 make no difference."""
    return replace(scene, opacities=scene.opacities.clamp(max=0.985))


@pytest.mark.parametrize("depth_grad_to_means", [True, False])
@pytest.mark.parametrize("degree", range(4))
def test_agrees_with_reference(gsplat, degree, depth_grad_to_means):
    view = camera(seed=degree)
    scene = below_the_cap(splats(view, degree=degree, seed=degree))
    got, grads = compare(scene, view, depth_grad_to_means=depth_grad_to_means)
    assert got.alpha.max() > 0.9 and (got.radii == 0).any()
    assert all(value.abs().max() > 0 for value in grads.values())


@pytest.mark.parametrize("width, height", [(1, 1), (16, 32), (33, 31), (7, 50)])
def test_agrees_at_any_size(gsplat, width, height):
    view = camera(width, height, seed=1)
    compare(below_the_cap(splats(view, 40, degree=1, seed=2, widths=(0.5, 6.0))), view)


def test_stopped_depth_reaches_z_no_more(gsplat):
    """Depth alone, of one Gaussian on the axis: its z gets the pixel's weight, or only what its footprint gives."""
    view = camera(seed=None)
    pulled = {}
    for stopped in (False, True):
        scene = one(view, view.cx, view.cy, 40.0)
        scene.means.requires_grad_()
        out = render.load("gsplat")(scene, view, background=torch.zeros(3), depth_grad_to_means=not stopped)
        out.depth.sum().backward()
        pulled[stopped] = scene.means.grad[0, 2]
    assert torch.isclose(pulled[False] - pulled[True], out.alpha.detach().sum(), rtol=1e-4)


def test_only_what_reaches_a_pixel_center_counts_as_rendered(gsplat, monkeypatch):
    """gsplat's box is rounded up to whole pixels, and so reaches the image from where the footprint does not."""
    boxes = []

    def kept(*args, **options):
        found = fully_fused_projection(*args, **options)
        boxes.append(found[0])
        return found

    monkeypatch.setattr(sys.modules["gsplat"], "fully_fused_projection", kept)
    view = camera(seed=None)
    scene = replace(one(view, -3.0, 10.5, 40.0), opacities=torch.tensor([0.12]))
    out = render.load("gsplat")(scene, view, background=torch.zeros(3))
    assert (boxes[0] > 0).all() and boxes[0].shape == (1, 1, 1, 2) and out.radii.tolist() == [0] and not out.alpha.any()


@pytest.mark.parametrize("name", NAMES)
@pytest.mark.parametrize("value", [NAN, float("inf"), -float("inf"), 3e38])
def test_poison_is_culled_and_carries_no_gradient(gsplat, name, value):
    view = camera()
    scene = below_the_cap(splats(view, degree=1))
    row = int(torch.nonzero(render_with_grads("reference", scene, view)[0].radii)[0])
    got, grads = render_with_grads("gsplat", poison(scene, name, row, value), view)
    others = torch.arange(len(scene)) != row
    want, _ = render_with_grads("gsplat", pick(scene, others), view)
    assert got.radii[row] == 0 and torch.equal(got.color, want.color) and torch.equal(got.depth, want.depth)
    assert all(grads[field].isfinite().all() and not grads[field][row].any() for field in (*NAMES, "means2d"))


def test_what_would_overflow_or_has_no_direction_is_culled(gsplat):
    view = camera(seed=None)
    scene = one(view, 20.5, 10.5, 40.0)
    for changes in ({"scales": torch.full((1, 3), 1e12)}, {"quats": torch.full((1, 4), 1e-13)}):
        out = render.load("gsplat")(replace(scene, **changes), view, background=torch.zeros(3))
        assert out.radii.tolist() == [0] and not out.alpha.any()


def test_near_plane_itself_is_culled(gsplat):
    view = camera(seed=None)
    at = float(np.float32(NEAR_Z))
    radii = []
    for z in (at, float(np.nextafter(np.float32(at), np.float32(1)))):
        scene = replace(one(view, view.cx, view.cy, 1.0), means=torch.tensor([[0.0, 0.0, z]]))
        radii.append(render.load("gsplat")(scene, view, background=torch.zeros(3)).radii.item())
    assert radii[0] == 0 and radii[1] > 0


def test_a_camera_far_from_the_origin_still_has_a_behind(gsplat):
    view = camera(seed=None)
    view.world_to_camera[:3, 3] = (3e8, -5e8, 9e8)
    tensors = gsplat.camera_tensors(view, torch.device("cpu"))
    assert tensors.depths(tensors.behind) < 0


def test_several_time_steps_in_one_call_equal_one_call_each(gsplat):
    views = [camera(seed=seed) for seed in range(3)]
    scenes = [splats(view, degree=1, seed=seed) for seed, view in enumerate(views)]
    background = torch.tensor([0.1, 0.2, 0.3])
    for got, scene, view in zip(
        gsplat.rasterize_many(scenes, views, background=background), scenes, views, strict=True
    ):
        want = gsplat.rasterize(scene, view, background=background)
        for name in ("color", "alpha", "depth", "means2d", "radii"):
            torch.testing.assert_close(getattr(got, name), getattr(want, name), rtol=1e-5, atol=1e-5)
    empty = [pick(scene, torch.arange(0)) for scene in scenes]
    assert len(gsplat.rasterize_many(empty, views, background=background)) == 3
    with pytest.raises(ValueError, match="must agree"):
        gsplat.rasterize_many([scenes[0], pick(scenes[1], torch.arange(5))], views[:2], background=background)
    with pytest.raises(ValueError, match="must agree"):
        gsplat.rasterize_many(scenes[:2], [views[0], replace(views[1], width=9)], background=background)


@pytest.mark.parametrize("num", [0, 3])
def test_without_visible_gaussians_the_image_is_the_background(gsplat, num):
    only_background("gsplat", num)


def test_cameras_are_kept_by_value(gsplat):
    view, device = camera(), torch.device("cpu")
    assert gsplat.camera_tensors(view, device) is gsplat.camera_tensors(camera(), device)
    before = gsplat.camera_tensors(view, device)
    view.world_to_camera[0, 3] += 1
    assert not torch.equal(gsplat.camera_tensors(view, device).viewmats, before.viewmats)


def test_other_types_and_devices_are_rejected(gsplat, monkeypatch):
    rejects_other_types(gsplat, monkeypatch)


def test_without_gsplat_one_line_says_what_to_install(monkeypatch):
    forget(monkeypatch)
    monkeypatch.setitem(sys.modules, "gsplat", None)
    with pytest.raises(
        InputError, match=r"^backend: gsplat cannot be imported.*pip install gsplat.*endoprior doctor[^\n]*$"
    ):
        render.load("gsplat")


def test_without_a_toolkit_one_line_says_so(monkeypatch):
    loaded(monkeypatch, kernels=None)
    view = camera()
    with pytest.raises(InputError, match=r"no CUDA toolkit.*endoprior doctor"):
        render.load("gsplat")(splats(view, 3), view, background=torch.zeros(3))


def test_a_build_that_fails_is_told_in_one_line(monkeypatch):
    module = loaded(monkeypatch, kernels=object())

    class Failing:
        def __getattr__(self, name):
            raise RuntimeError("Ninja is required\nto load C++ extensions")

    monkeypatch.setitem(sys.modules, "gsplat.cuda._backend", Failing())
    view = camera()
    with pytest.raises(
        InputError, match=r"cannot build its CUDA kernels \(Ninja is required\)\. Run `pip install gsplat`"
    ):
        module.rasterize(splats(view, 3), view, background=torch.zeros(3))
