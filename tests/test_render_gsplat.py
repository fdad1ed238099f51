"""The gsplat backend without a GPU, on a stand-in for gsplat written here from its contracts.

The stand-in keeps gsplat's shapes, its bounds and its traps: what it culls it neither reads nor writes, and unwritten
rows are NaN. What only a GPU can show is for `bench/gpu.py` to check.
"""

from __future__ import annotations

import importlib
import sys
from dataclasses import replace
from types import ModuleType

import numpy as np
import pytest
import torch
from render_scenes import NAMES, camera, draw, one, pick, poison, splats

from endoprior import render
from endoprior.core.checks import InputError
from endoprior.core.types import Splats
from endoprior.render import sh as harmonics
from endoprior.render.constants import NEAR_Z
from endoprior.render.projection import rotation_matrices

NAN = float("nan")
CAP, EDGE, STOP = 0.999, 1 / 255, 1e-4


def fully_fused_projection(
    means, covars, quats, scales, viewmats, Ks, width, height, *, eps2d, near_plane, far_plane, opacities
):
    """(B, 1, N, ...) radii int32 x and y, means2d, depths, conics, None; packed and compensations off."""
    steps = len(means)
    assert covars is None and viewmats.shape == (steps, 1, 4, 4) and Ks.shape == (steps, 1, 3, 3)
    assert not opacities.requires_grad and opacities.shape == means.shape[:2]
    each = [
        project_one(*one_of, width, height, eps2d, near_plane, far_plane)
        for one_of in zip(means, quats, scales, viewmats[:, 0], Ks[:, 0], opacities, strict=True)
    ]
    return *(torch.stack(parts)[:, None] for parts in zip(*each, strict=True)), None


def project_one(means, quats, scales, view, k, opacities, width, height, eps2d, near_plane, far_plane):
    """One camera's part of `fully_fused_projection`."""
    (fx, fy), (cx, cy) = k.diagonal()[:2], k[:2, 2]
    x, y, z = (means @ view[:3, :3].T + view[:3, 3]).unbind(-1)
    ahead = (z >= near_plane)[:, None]
    quats, scales = torch.where(ahead, quats, 1.0), torch.where(ahead, scales, 1.0)
    margin_x, margin_y = 0.15 * width / fx, 0.15 * height / fy
    slope_x = (x / z).clamp(-cx / fx - margin_x, (width - cx) / fx + margin_x)
    slope_y = (y / z).clamp(-cy / fy - margin_y, (height - cy) / fy + margin_y)
    zero = torch.zeros_like(z)
    rows = [torch.stack([fx / z, zero, -fx * slope_x / z], -1), torch.stack([zero, fy / z, -fy * slope_y / z], -1)]
    spread = torch.stack(rows, -2) @ view[:3, :3] @ (rotation_matrices(quats) * scales[:, None, :])
    cov = spread @ spread.mT + eps2d * torch.eye(2)
    conic = torch.linalg.inv(cov)
    means2d = torch.stack([fx * x / z + cx, fy * y / z + cy], -1)
    with torch.no_grad():
        extent = (2 * (opacities / EDGE).log()).sqrt().clamp(max=3.33)
        box = (extent[:, None] * cov.diagonal(dim1=-2, dim2=-1).sqrt()).ceil()
        size = torch.tensor([width, height])
        seen = (z >= near_plane) & (z <= far_plane) & (opacities >= EDGE)
        seen &= ((means2d + box > 0) & (means2d - box < size)).all(-1)
        radii = torch.where(seen[:, None], box, 0).int()
    unwritten = ~seen[:, None]
    conics = torch.stack([conic[:, 0, 0], conic[:, 0, 1], conic[:, 1, 1]], -1)
    means2d, conics = means2d.masked_fill(unwritten, NAN), conics.masked_fill(unwritten, NAN)
    return radii, means2d, z.masked_fill(~seen, NAN), conics


def spherical_harmonics(degree, dirs, coeffs, masks=None):
    """(B, N, 3) sums; directions need not be unit vectors; rows masked out are never written."""
    assert masks.dtype == torch.bool and coeffs.shape == (*dirs.shape[:2], (degree + 1) ** 2, 3)
    dirs, coeffs = torch.where(masks[..., None], dirs, 1.0), torch.where(masks[..., None, None], coeffs, 0.0)
    values = harmonics.basis((dirs / dirs.norm(dim=-1, keepdim=True)).flatten(0, 1), degree).view(*coeffs.shape[:3])
    return (values[..., None] * coeffs).sum(2).masked_fill(~masks[..., None], NAN)


@torch.no_grad()
def isect_tiles(means2d, radii, depths, tile_size, tile_width, tile_height):
    """Tiles per Gaussian (B, N), sorted 64-bit ids (picture, tile, bits of z), and the Gaussian of each (P,) int32."""
    ids, owners = [], []
    bits, (steps, num) = depths.contiguous().view(torch.int32).tolist(), depths.shape
    for m, n in torch.nonzero((radii > 0).all(-1)).tolist():
        low = ((means2d[m, n] - radii[m, n]) / tile_size).floor().long().clamp(min=0).tolist()
        high = ((means2d[m, n] + radii[m, n]) / tile_size).ceil().long().tolist()
        for row in range(low[1], min(high[1], tile_height)):
            for column in range(low[0], min(high[0], tile_width)):
                ids.append(((m * tile_height + row) * tile_width + column) << 32 | bits[m][n])
                owners.append(m * num + n)
    order = np.argsort(np.array(ids, np.int64), kind="stable")
    counts = torch.bincount(torch.tensor(owners, dtype=torch.int64), minlength=steps * num).int().view(steps, num)
    return counts, torch.tensor(ids, dtype=torch.int64)[order], torch.tensor(owners, dtype=torch.int32)[order]


@torch.no_grad()
def isect_offset_encode(isect_ids, n_images, tile_width, tile_height):
    """(B, tile_height, tile_width) int32 where each tile's pairs begin."""
    tiles = torch.arange(n_images * tile_width * tile_height)
    return torch.searchsorted(isect_ids >> 32, tiles).int().view(n_images, tile_height, tile_width)


def rasterize_to_pixels(
    means2d, conics, colors, opacities, width, height, tile_size, isect_offsets, flatten_ids, backgrounds=None
):
    """(B, H, W, C) color and (B, H, W, 1) alpha, tile by tile."""
    channels, (steps, num) = colors.shape[-1], opacities.shape
    assert backgrounds is None and means2d.shape == (steps, num, 2) and conics.shape == (steps, num, 3)
    flat = [values.flatten(0, 1) for values in (means2d, conics, colors, opacities)]
    starts = isect_offsets.flatten(1).tolist()
    ends = [*(row[0] for row in starts[1:]), len(flatten_ids)]
    drawn = torch.stack(
        [
            pixels_of_one(*flat, width, height, tile_size, isect_offsets.shape[1:], [*row, end], flatten_ids)
            for row, end in zip(starts, ends, strict=True)
        ]
    )
    return drawn[..., :channels], drawn[..., channels:]


def pixels_of_one(means2d, conics, colors, opacities, width, height, tile_size, tiles_yx, ends, flatten_ids):
    """(H, W, C + 1) color and alpha of one picture."""
    rows = []
    for row in range(tiles_yx[0]):
        tiles = []
        for column in range(tiles_yx[1]):
            tile = row * tiles_yx[1] + column
            ids = flatten_ids[ends[tile] : ends[tile + 1]].long()
            ys = torch.arange(row * tile_size, min((row + 1) * tile_size, height)) + 0.5
            xs = torch.arange(column * tile_size, min((column + 1) * tile_size, width)) + 0.5
            pixels = torch.stack(torch.meshgrid(xs, ys, indexing="xy"), -1)
            dx, dy = (means2d[ids] - pixels[:, :, None]).unbind(-1)
            a, b, c = conics[ids].unbind(-1)
            alpha = (opacities[ids] * torch.exp(-0.5 * (a * dx * dx + c * dy * dy) - b * dx * dy)).clamp(max=CAP)
            alpha = torch.where(alpha >= EDGE, alpha, 0)
            alpha = alpha * (torch.cumprod(1 - alpha.detach(), -1) > STOP)
            left = torch.cumprod(torch.cat([torch.ones(*alpha.shape[:2], 1), 1 - alpha], -1), -1)
            color = (alpha * left[..., :-1]) @ colors[ids]
            tiles.append(torch.cat([color, 1 - left[..., -1:]], -1))
        rows.append(torch.cat(tiles, 1))
    return torch.cat(rows)


@pytest.fixture
def gsplat(monkeypatch):
    """The backend's module on the stand-in, rendering on the CPU."""
    return loaded(monkeypatch, kernels=object())


def loaded(monkeypatch, kernels):
    """A fresh import of the backend with a gsplat whose compiled part is `kernels`."""
    fake = ModuleType("gsplat")
    functions = (fully_fused_projection, spherical_harmonics, isect_tiles, isect_offset_encode, rasterize_to_pixels)
    for function in functions:
        setattr(fake, function.__name__, function)
    for name, module in {"gsplat": fake, "gsplat.cuda": ModuleType("cuda"), "gsplat.cuda._backend": fake}.items():
        monkeypatch.setitem(sys.modules, name, module)
    fake._C = kernels
    forget(monkeypatch)
    module = importlib.import_module("endoprior.render.gsplat")
    monkeypatch.setattr(module, "DEVICE", "cpu")
    return module


def forget(monkeypatch):
    """Make the next import of the backend a real one, now and after the test."""
    monkeypatch.delitem(sys.modules, "endoprior.render.gsplat", raising=False)
    monkeypatch.setitem(sys.modules, "endoprior.render.gsplat", ModuleType("put aside"))  # undone last: nothing stays
    del sys.modules["endoprior.render.gsplat"]


def compare(scene, view, **options):
    """Picture within 1e-4 of the reference (depth: of its largest), gradients within 1 %."""
    want, want_grads = draw("reference", scene, view, **options)
    got, grads = draw("gsplat", scene, view, **options)
    assert (got.color - want.color).abs().max() < 1e-4
    assert (got.alpha - want.alpha).abs().max() < 1e-4
    assert (got.depth - want.depth).abs().max() < 1e-4 * want.depth.abs().max().clamp(min=1)
    assert torch.equal(got.radii > 0, want.radii > 0) and got.radii.dtype == torch.int32
    assert (got.radii - want.radii).abs().max() <= 1  # ceil may fall on either side
    drawn = want.radii > 0
    assert torch.allclose(got.means2d[drawn].double(), want.means2d[drawn], atol=1e-3)
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


def test_only_what_reaches_a_pixel_center_counts_as_drawn(gsplat, monkeypatch):
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
    row = int(torch.nonzero(draw("reference", scene, view)[0].radii)[0])
    got, grads = draw("gsplat", poison(scene, name, row, value), view)
    others = torch.arange(len(scene)) != row
    want, _ = draw("gsplat", pick(scene, others), view)
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
    lens = gsplat.lens_of(view, torch.device("cpu"))
    assert (lens.behind * lens.z_row).sum() + lens.z_shift < 0


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
    view = camera()
    scene = pick(splats(view), torch.arange(num))
    scene = replace(scene, means=scene.means - 1e4 * torch.tensor(view.world_to_camera[2, :3]).float())
    got, grads = draw("gsplat", scene, view)
    assert (got.color == torch.tensor([0.1, 0.2, 0.3])).all() and not got.alpha.any() and not got.depth.any()
    assert got.means2d.shape == (num, 2) and not got.radii.any()
    assert all(not grads[name].any() for name in (*NAMES, "means2d")) and grads["background"].any()


def test_cameras_are_kept_by_value(gsplat):
    view, device = camera(), torch.device("cpu")
    assert gsplat.lens_of(view, device) is gsplat.lens_of(camera(), device)
    before = gsplat.lens_of(view, device)
    view.world_to_camera[0, 3] += 1
    assert not torch.equal(gsplat.lens_of(view, device).viewmats, before.viewmats)


def test_other_types_and_devices_are_rejected(gsplat, monkeypatch):
    view = camera()
    scene = splats(view, 3)
    doubled = Splats(*(getattr(scene, name).double() for name in NAMES))
    with pytest.raises(ValueError, match=r"float32 on one cpu device; got torch.float64"):
        gsplat.rasterize(doubled, view, background=torch.zeros(3).double())
    with pytest.raises(ValueError, match=r"on one cpu device; got torch.float32 on .'cpu', 'meta'"):
        gsplat.rasterize(replace(scene, sh=scene.sh.to("meta")), view, background=torch.zeros(3))
    monkeypatch.setattr(gsplat, "DEVICE", "cuda")
    with pytest.raises(ValueError, match=r"one cuda device; got torch.float32 on .'cpu'"):
        gsplat.rasterize(scene, view, background=torch.zeros(3))


def test_without_gsplat_one_line_says_what_to_install(monkeypatch):
    forget(monkeypatch)
    monkeypatch.setitem(sys.modules, "gsplat", None)
    with pytest.raises(
        InputError, match=r"^backend: gsplat cannot be imported.*endoprior\[cuda\].*endoprior doctor[^\n]*$"
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
    with pytest.raises(InputError, match=r"cannot build its CUDA kernels \(Ninja is required\)\. Install"):
        module.rasterize(splats(view, 3), view, background=torch.zeros(3))
