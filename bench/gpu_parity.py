"""Whether a GPU backend gives the images and gradients of the Numba backend and the reference."""

from __future__ import annotations

import math
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
import torch
from scipy.spatial.transform import Rotation
from torch import Tensor

from endoprior import render
from endoprior.core.types import Camera, Splats
from endoprior.model.scene_file import load_scene
from endoprior.render.constants import ALPHA_MAX

SCENES, FRAMES = 20, 3
IMAGE_LIMIT, GRADIENT_LIMIT = 1e-3, 0.01
"""Largest difference of color, alpha and depth / largest depth; and of a gradient, relative to its norm."""
STRAY_PIXELS = {"random": 1e-4, "trained": 5e-4}
"""Share of pixels that may differ by more: where an edge depends on the last bits, and in a trained scene where gsplat
1.5.3 lets alpha reach 0.999 (see render/gsplat.py)."""
WINDOW = (112, 80)
"""px, the part of a trained scene's image that interpreted kernels render, in some minutes."""
MAX_OPACITY = 0.985
"""Of random scenes: below where the two caps on alpha differ."""
IMAGES = ("color", "alpha", "depth")


@dataclass(frozen=True)
class Target:
    """A backend under test, and the device it runs on."""

    backend: render.Backend
    device: torch.device


@dataclass(frozen=True)
class Case:
    """One scene to agree on."""

    kind: str
    """`random` or `trained`."""
    name: str
    splats: Splats
    camera: Camera
    depth_grad_to_means: bool


@dataclass(frozen=True)
class Difference:
    """How far a backend is from another one on one scene."""

    backend: str
    kind: str
    """`random` or `trained`."""
    scene: str
    against: str
    color: float
    """Largest difference of a channel."""
    alpha: float
    depth_mm: float
    depth: float
    """The same divided by the largest depth."""
    stray: float
    """Share of pixels in which any of color, alpha and depth differs by more than IMAGE_LIMIT."""
    gradient: float
    """Largest relative difference of a gradient, and"""
    worst: str
    """whose."""

    @property
    def agrees(self) -> bool:
        return self.stray <= STRAY_PIXELS[self.kind] and self.gradient <= GRADIENT_LIMIT


def random_case(seed: int) -> Case:
    """150 Gaussians in and around a small image, camera rotated and off-center; SH degree 0 to 3 in turn."""
    rng = np.random.default_rng(seed)
    width, height = int(rng.integers(40, 100)), int(rng.integers(40, 100))
    pose = np.eye(4)
    pose[:3, :3] = Rotation.from_rotvec(rng.normal(size=3) * 0.5).as_matrix()
    pose[:3, 3] = rng.normal(size=3) * 5
    view = Camera(width, height, 1.1 * width, 1.3 * width, 0.45 * width, 0.6 * height, pose)
    num, degree = 150, seed % 4
    z = rng.uniform(30, 60, num)
    x = (rng.uniform(-0.3, 1.3, num) * width - view.cx) / view.fx * z
    y = (rng.uniform(-0.3, 1.3, num) * height - view.cy) / view.fy * z
    values = (
        (np.stack([x, y, z], -1) - pose[:3, 3]) @ pose[:3, :3],
        rng.normal(size=(num, 4)) * 2,
        np.exp(rng.uniform(np.log(0.2), np.log(6.0), (num, 3))) * (z / view.fx)[:, None],
        rng.uniform(0.01, MAX_OPACITY, num),
        rng.normal(size=(num, (degree + 1) ** 2, 3)) * 0.3,
        rng.normal(size=(num, 2, 3)) * 0.1,
    )
    splats = Splats(*(torch.tensor(v, dtype=torch.float32) for v in values))
    return Case("random", f"random {seed}", splats, view, seed % 2 == 0)


def trained_cases(run: Path, *, window: bool) -> list[Case]:
    """A few frames of a trained scene, or a small window of the first one."""
    scene, found = load_scene(run), []
    for index in np.linspace(0, len(scene.cameras) - 1, 1 if window else FRAMES).round().astype(int).tolist():
        splats = scene.at(index / len(scene.cameras))
        opaque = int((splats.opacities > ALPHA_MAX).sum())
        name = f"trained, frame {index}, {len(scene):,} Gaussians, {opaque:,} of opacity > {ALPHA_MAX}"
        view = cropped(scene.cameras[index]) if window else scene.cameras[index]
        found.append(Case("trained", name, splats, view, scene.config.render.depth_grad_to_means))
    return found


def cropped(view: Camera) -> Camera:
    width, height = (min(size, limit) for size, limit in zip((view.width, view.height), WINDOW, strict=True))
    left, top = (view.width - width) // 2, (view.height - height) // 2
    return replace(view, width=width, height=height, cx=view.cx - left, cy=view.cy - top)


def rendered(backend: render.Backend, device: torch.device, case: Case) -> tuple[dict[str, Tensor], dict[str, Tensor]]:
    """Images, and gradients under seeded random cotangents, as float64 on the CPU. The reference computes in it."""
    dtype = torch.float64 if backend == "reference" else torch.float32
    given = case.splats.tensors.items()
    leaves = {name: value.detach().to(device, dtype).clone().requires_grad_() for name, value in given}
    background = torch.tensor([0.1, 0.2, 0.3], dtype=dtype, device=device)
    rasterize = render.load(backend)
    out = rasterize(Splats(**leaves), case.camera, background=background, depth_grad_to_means=case.depth_grad_to_means)
    out.means2d.retain_grad()
    generator = torch.Generator().manual_seed(0)
    pulled = background.new_zeros(())
    for name in IMAGES:
        image = getattr(out, name)
        pulled = pulled + (torch.randn(image.shape, generator=generator).to(image) * image).sum()
    pulled.backward()
    grads = {name: leaf.grad for name, leaf in leaves.items()} | {"means2d": out.means2d.grad}
    return on_cpu({name: getattr(out, name) for name in IMAGES}), on_cpu(grads)


def on_cpu(tensors: dict[str, Tensor]) -> dict[str, Tensor]:
    return {name: tensor.detach().double().cpu() for name, tensor in tensors.items()}


def compared(target: Target, against: render.Backend, case: Case) -> Difference:
    images, grads = rendered(target.backend, target.device, case)
    wanted, wanted_grads = rendered(against, torch.device("cpu"), case)
    off = {name: numbers((images[name] - wanted[name]).abs()) for name in IMAGES}
    off["color"] = off["color"].amax(-1)
    largest = wanted["depth"].max().clamp(min=1e-12)
    stray = (off["color"] > IMAGE_LIMIT) | (off["alpha"] > IMAGE_LIMIT) | (off["depth"] / largest > IMAGE_LIMIT)
    wanted_norms = {name: v.norm().clamp(min=1e-12) for name, v in wanted_grads.items()}
    relative = {name: float(numbers((grads[name] - wanted_grads[name]).norm() / v)) for name, v in wanted_norms.items()}
    worst = max(relative, key=relative.__getitem__)
    return Difference(
        backend=target.backend,
        kind=case.kind,
        scene=case.name,
        against=against,
        **{name: float(off[name].max()) for name in ("color", "alpha")},
        depth_mm=float(off["depth"].max()),
        depth=float(off["depth"].max() / largest),
        stray=float(stray.double().mean()),
        gradient=relative[worst],
        worst=worst,
    )


def numbers(values: Tensor) -> Tensor:
    """The values with infinity in place of NaN, which would pass every comparison."""
    return values.nan_to_num(nan=math.inf)


def agreement(target: Target, num_scenes: int, run: Path | None) -> list[Difference]:
    """Random scenes against Numba and the reference, frames of a trained scene against Numba."""
    cases = [random_case(seed) for seed in range(num_scenes)]
    found = [compared(target, against, case) for case in cases for against in ("numba", "reference")]
    window = target.device.type == "cpu" and target.backend == "triton"  # interpreted
    return found + [compared(target, "numba", case) for case in (trained_cases(run, window=window) if run else [])]
