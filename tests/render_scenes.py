"""Small random scenes for the renderer's tests, in float32 numbers so that every backend gets the same input."""

from __future__ import annotations

from dataclasses import fields, replace

import numpy as np
import pytest
import torch
from scipy.spatial.transform import Rotation
from torch import Tensor

from endoprior import render
from endoprior.core.types import Camera, RenderOutput, Splats

NAMES = tuple(field.name for field in fields(Splats))


def camera(width: int = 50, height: int = 37, seed: int | None = 0) -> Camera:
    """A camera with unequal focal lengths and an off-center principal point; seed None: at the origin, unrotated."""
    pose = np.eye(4)
    if seed is not None:
        rng = np.random.default_rng(seed)
        pose[:3, :3] = Rotation.from_rotvec(rng.normal(size=3) * 0.5).as_matrix()
        pose[:3, 3] = rng.normal(size=3) * 5
    return Camera(width, height, 1.1 * width, 1.3 * width, 0.45 * width, 0.6 * height, pose)


def splats(
    view: Camera, num: int = 60, degree: int = 3, seed: int = 0, widths: tuple[float, float] = (0.2, 4.0)
) -> Splats:
    """Gaussians at 30-60 mm over and around the image; standard deviations in `widths`, px, each axis on its own."""
    rng = np.random.default_rng(seed)
    z = rng.uniform(30, 60, num)
    x = (rng.uniform(-0.3, 1.3, num) * view.width - view.cx) / view.fx * z
    y = (rng.uniform(-0.3, 1.3, num) * view.height - view.cy) / view.fy * z
    to_world = np.linalg.inv(view.world_to_camera)
    scales = np.exp(rng.uniform(*np.log(widths), (num, 3))) * (z / view.fx)[:, None]
    values = (
        np.stack([x, y, z], -1) @ to_world[:3, :3].T + to_world[:3, 3],
        rng.normal(size=(num, 4)) * 2,
        scales,
        rng.uniform(0.01, 0.999, num),
        rng.normal(size=(num, (degree + 1) ** 2, 3)) * 0.3,
        rng.normal(size=(num, 2, 3)) * 0.1,
    )
    return Splats(*(torch.tensor(v, dtype=torch.float32) for v in values))


def one(view: Camera, x: float, y: float, z: float, **changes: Tensor) -> Splats:
    """A round gray Gaussian of opacity 0.6 and 1 px whose center projects to (x, y); the camera must be unrotated."""
    assert np.array_equal(view.world_to_camera, np.eye(4))
    values = {
        "means": torch.tensor([[(x - view.cx) / view.fx * z, (y - view.cy) / view.fy * z, z]]),
        "quats": torch.tensor([[1.0, 0.0, 0.0, 0.0]]),
        "scales": torch.full((1, 3), z / view.fx),
        "opacities": torch.tensor([0.6]),
        "sh": torch.zeros(1, 1, 3),
        "color_slopes": torch.zeros(1, 2, 3),
    }
    return Splats(**(values | changes))


def cast(scene: Splats, dtype: torch.dtype) -> Splats:
    """The same numbers as fresh leaves that require gradients."""
    tensors = scene.tensors.items()
    return Splats(**{name: value.detach().to(dtype).clone().requires_grad_() for name, value in tensors})


def pick(scene: Splats, rows: Tensor) -> Splats:
    """Some of the Gaussians, in that order."""
    return Splats(*(getattr(scene, name)[rows] for name in NAMES))


def poison(scene: Splats, name: str, row: int, value: float) -> Splats:
    """A copy in which all numbers of one field of one Gaussian are `value`."""
    changed = getattr(scene, name).clone()
    changed[row] = value
    return replace(scene, **{name: changed})


def render_with_grads(
    backend: str,
    scene: Splats,
    view: Camera,
    *,
    background: tuple[float, float, float] = (0.1, 0.2, 0.3),
    depth_grad_to_means: bool = True,
    dtype: torch.dtype | None = None,
    seed: int = 0,
) -> tuple[RenderOutput, dict[str, Tensor]]:
    """Render, and pull seeded random cotangents of color, depth and alpha back to every input.

    Returns:
        the image, and the gradients by name, those of `means2d` and `background` among them. float64 for the
        reference unless `dtype` says otherwise.
    """
    dtype = dtype or (torch.float64 if backend == "reference" else torch.float32)
    scene, behind = cast(scene, dtype), torch.tensor(background, dtype=dtype, requires_grad=True)
    out = render.load(backend)(scene, view, background=behind, depth_grad_to_means=depth_grad_to_means)
    out.means2d.retain_grad()
    generator = torch.Generator().manual_seed(seed)
    pulled = 0
    for image in (out.color, out.depth, out.alpha):
        pulled = pulled + (torch.randn(image.shape, generator=generator).to(dtype) * image).sum()
    pulled.backward()
    grads = {name: value.grad for name, value in scene.tensors.items()}
    return out, grads | {"means2d": out.means2d.grad, "background": behind.grad}


def agree(got, want, relative, name):
    """Largest difference, in units of the largest value."""
    scale = want.abs().max().clamp(min=1e-12)
    gap = ((got.double() - want) / scale).abs().max()
    assert gap <= relative, f"{name} differs by {gap:.1e} of its largest value"


def compare(backend, scene, view, image=2e-6, gradient=2e-5, **options):
    """Color, alpha and depth within a few float32 roundings per layer; gradients sum more of them."""
    want, want_grads = render_with_grads("reference", scene, view, **options)
    got, grads = render_with_grads(backend, scene, view, **options)
    for name in ("color", "alpha", "depth"):
        agree(getattr(got, name), getattr(want, name), image, name)
    rendered = want.radii > 0
    agree(got.means2d[rendered], want.means2d[rendered], 1e-6, "means2d")
    assert torch.equal(got.radii > 0, rendered)
    assert (got.radii - want.radii).abs().max() <= 1  # ceil may fall on either side
    for name, value in want_grads.items():
        agree(grads[name], value, gradient, f"gradient of {name}")
    return want, want_grads


def agree_where_full(backend, scene, view):
    """Opaque layers: ALPHA_MAX binds, pixels stop, tiles are left early. Returns the reference's image.

    Rounding of the transmittance can decide otherwise than float64 at a stop, hence the share that may differ.
    """
    want, want_grads = render_with_grads("reference", scene, view)
    got, grads = render_with_grads(backend, scene, view)
    off = ((got.color - want.color).abs().max(-1).values > 1e-5).float().mean()
    assert off < 0.005, f"{off:.2%} of pixels differ"
    for name in ("sh", "opacities", "means2d"):
        gap = (grads[name] - want_grads[name]).norm() / want_grads[name].norm()
        assert gap < 1e-3, f"gradient of {name} differs by {gap:.1e}"
    return want


def only_background(backend, num):
    """`num` Gaussians, all behind the camera, show nothing and get no gradient."""
    view = camera(33, 21)
    scene = pick(splats(view), torch.arange(num))
    scene = replace(scene, means=scene.means - 1e4 * torch.tensor(view.world_to_camera[2, :3]).float())
    got, grads = render_with_grads(backend, scene, view, dtype=torch.float32)
    assert (got.color == torch.tensor([0.1, 0.2, 0.3])).all() and not got.alpha.any() and not got.depth.any()
    assert got.means2d.shape == (num, 2) and not got.radii.any()
    assert all(not grads[name].any() for name in (*NAMES, "means2d")) and grads["background"].any()


def rejects_other_types(module, monkeypatch):
    """The module of a GPU backend, here on the CPU, wants float32 on one device of its type."""
    view = camera(16, 9)
    scene = splats(view, 3)
    doubled = Splats(*(getattr(scene, name).double() for name in NAMES))
    with pytest.raises(ValueError, match=r"float32 on one cpu device; got torch.float64"):
        module.rasterize(doubled, view, background=torch.zeros(3).double())
    with pytest.raises(ValueError, match=r"on one cpu device; got torch.float32 on .'cpu', 'meta'"):
        module.rasterize(replace(scene, sh=scene.sh.to("meta")), view, background=torch.zeros(3))
    monkeypatch.setattr(module, "DEVICE", "cuda")
    with pytest.raises(ValueError, match=r"one cuda device; got torch.float32 on .'cpu'"):
        module.rasterize(scene, view, background=torch.zeros(3))


def asks_for_one_gradient(backend):
    """A loss whose cotangents are expanded, most inputs frozen, one of them not contiguous."""
    view = camera(23, 13)
    scene = splats(view, 40, degree=1)
    scene = replace(scene, sh=scene.sh.transpose(0, 1).contiguous().transpose(0, 1))
    assert not scene.sh.is_contiguous()
    found = {}
    for name, dtype in (("reference", torch.float64), (backend, torch.float32)):
        values = {field: getattr(scene, field).to(dtype) for field in NAMES}
        values["opacities"].requires_grad_()
        out = render.load(name)(Splats(**values), view, background=torch.zeros(3, dtype=dtype))
        (out.alpha.sum() + out.color.sum()).backward()
        found[name] = values["opacities"].grad
    agree(found[backend], found["reference"], 1e-5, "gradient of opacities")
