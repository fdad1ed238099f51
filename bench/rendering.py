"""Rendering beside plain torch: projection, binning, compositing, and a whole scene with the share of each part."""

from __future__ import annotations

import common
import numpy as np
import plain
import scenes
import torch
from torch import Tensor

import endoprior
from endoprior.core.types import Camera, RenderOutput, Splats
from endoprior.model.basis import BasisMotion, basis_offsets
from endoprior.model.hexplane_field import HexPlaneField, HexPlaneMotion
from endoprior.model.ops import TORCH
from endoprior.model.playback import Playback
from endoprior.model.presets import preset
from endoprior.model.scene import SingleScene
from endoprior.render import numba as numba_backend
from endoprior.render.autograd import Project
from endoprior.render.numba import KERNELS
from endoprior.render.projection import Projected, project

PRESETS = ("default", "paper")
TIME = 0.4
IMAGE = (640, 512)
"""It matters to projection only for what is culled, which is next to nothing here."""
TORCH_MOST = 20_000
"""Gaussians; with more, autograd's memory alone takes torch from seconds to minutes."""
PARTS = {
    "deformation": [(HexPlaneMotion, "offsets"), (BasisMotion, "offsets")],
    "projection + SH": [(numba_backend, "project_forward")],
    "binning + sort": [(numba_backend.tiles, "build")],
    "compositing": [(numba_backend, "composite_forward")],
}
INPUTS = ("means", "quats", "scales", "sh", "color_slopes")


def projection(sizes: tuple[common.Size, ...]) -> list[common.Row]:
    """Projection and spherical harmonics, forward and backward: two rows for each number of Gaussians."""
    measured = []
    for num in common.nums(sizes):
        splats, camera = scenes.splats(common.Size(num, *IMAGE))
        inputs = [getattr(splats, name).requires_grad_() for name in INPUTS]
        cotangents = [torch.randn(shape) for shape in ((num, 2), (num, 3), (num,), (num, 3), (num, 2, 3))]
        ours = {
            "forward": lambda _, i=inputs, s=splats, c=camera: Project.apply(KERNELS, c, s.opacities, *i)[:5],
            "backward": lambda out, i=inputs, v=cotangents: torch.autograd.grad(out, i, v),
        }
        theirs = ours | {"forward": lambda _, s=splats, c=camera: list(vars(project(s, c)).values())[:5]}
        measured += common.rows("projection + SH", common.race(ours, theirs), num)
    return measured


def projected(splats: Splats, camera: Camera) -> tuple[tuple[Tensor, ...], Tensor]:
    inputs = tuple(getattr(splats, name) for name in INPUTS)
    *found, radii = KERNELS.project_forward(inputs, splats.opacities, camera)
    return (*found, splats.opacities), radii


def binning(sizes: tuple[common.Size, ...]) -> list[common.Row]:
    """Sorting into tiles, near to far, beside the same in vectorized torch: one row for each size."""
    measured = []
    for size in sizes:
        splats, camera = scenes.splats(size)
        gaussians, radii = projected(splats, camera)
        seen, image = project(splats, camera), (size.width, size.height)
        ours = {"": lambda _, g=gaussians, r=radii, s=image: KERNELS.bin_tiles(g, r, s)}
        theirs = {"": lambda _, s=seen, o=splats.opacities, p=image: plain.bin_tiles(s, o, *p)}
        measured += common.rows("binning + sort", common.race(ours, theirs), size.num, image)
    return measured


def compositing(sizes: tuple[common.Size, ...]) -> list[common.Row]:
    """Two rows for each size, beside a plain torch compositor; backward counts the sum of the pairs per Gaussian."""
    measured = []
    for size in sizes:
        splats, camera = scenes.splats(size)
        v_image = torch.from_numpy(np.random.default_rng(1).normal(size=(size.height, size.width, 5))).float()
        cotangents = (v_image[..., :3], v_image[..., 3], v_image[..., 4])  # of color, depth, alpha
        theirs = torch_compositing(splats, camera, *cotangents) if size.num <= TORCH_MOST else None
        result = common.race(our_compositing(splats, camera, *cotangents), theirs)
        measured += common.rows("compositing", result, size.num, (size.width, size.height))
    return measured


def our_compositing(splats: Splats, camera: Camera, *cotangents: Tensor) -> common.Steps:
    """The kernels on Gaussians that are already in the image and sorted into tiles."""
    gaussians, radii = projected(splats, camera)
    size = (camera.width, camera.height)
    tiles = KERNELS.bin_tiles(gaussians, radii, size)
    shape, given = (gaussians[1], gaussians[4], splats.opacities), tuple(part.contiguous() for part in cotangents)
    return {
        "forward": lambda _: KERNELS.composite_forward(tiles, torch.zeros(3), size),
        "backward": lambda out: KERNELS.composite_backward(tiles, out[3], *shape, out[:3], given),
    }


def torch_compositing(
    splats: Splats, camera: Camera, v_color: Tensor, v_depth: Tensor, v_alpha: Tensor
) -> common.Steps:
    """The same in plain torch, tile by tile under autograd, one color per Gaussian."""
    seen, opacities = project(splats, camera), splats.opacities.clone().requires_grad_()
    bins = plain.bin_tiles(seen, opacities, camera.width, camera.height)
    inputs = [t.clone().requires_grad_() for t in (seen.means2d, seen.cov2d, seen.z, seen.colors)]
    means2d, cov2d, z, colors = inputs
    given = Projected(means2d, cov2d, seen.det, z, colors, seen.color_slopes2d, seen.radii)
    background = torch.zeros(3)
    return {
        "forward": lambda _: plain.composite(given, opacities, bins, background, camera.width, camera.height),
        "backward": lambda out: torch.autograd.grad(out, [*inputs, opacities], [v_color, v_alpha, v_depth]),
    }


def rendering(sizes: tuple[common.Size, ...]) -> list[common.Row]:
    """For each preset and size one row for the whole, then one for each part; last, frames kept for playing."""
    measured = []
    for name in PRESETS:
        cfg, field = preset(name).fitted(68), None
        for size in sizes:
            splats, camera = scenes.splats(size)
            if cfg.deformation.kind == "hexplane" and field is None:  # the volume is the same at all sizes
                field = HexPlaneField.from_points(splats.means, cfg.deformation, torch.Generator().manual_seed(0))
            scene = scenes.scene(splats, (camera,), cfg, field)
            ours = {"": lambda _, s=scene: s.render(TIME)}
            theirs = torch_rendering(scene) if size.num <= TORCH_MOST else None
            image = (size.width, size.height)
            measured += common.rows(f"rendering {name}", common.race(ours, theirs), size.num, image)
            measured += common.part_rows(f"rendering {name}", ours, PARTS, size)
    for size in sizes:
        measured += kept_rows(size)
    return measured


def public(sizes: tuple[common.Size, ...]) -> list[common.Row]:
    """`endoprior.rasterize`, forward and backward to every input, beside the same in plain torch: two rows a size."""
    measured = []
    for size in sizes:
        if size.num <= TORCH_MOST:
            measured += common.rows("rasterize", common.race(*public_steps(size)), size.num, (size.width, size.height))
    return measured


def public_steps(size: common.Size) -> tuple[common.Steps, common.Steps]:
    splats, camera = scenes.splats(size)
    inputs = [getattr(splats, name).requires_grad_() for name in ("means", "quats", "scales", "opacities", "sh")]
    matrix = torch.tensor([[[camera.fx, 0, camera.cx], [0, camera.fy, camera.cy], [0, 0, 1]]])
    view, background, cotangent = torch.eye(4)[None], torch.zeros(3), torch.randn(size.height, size.width, 3)

    def ours(_: object) -> Tensor:
        return endoprior.rasterize(*inputs, view, matrix, size.width, size.height, sh_degree=3)[0][0]

    def theirs(_: object) -> Tensor:
        return plain.rasterize(splats, camera, background=background).color

    def backward(image: Tensor) -> tuple[Tensor, ...]:
        return torch.autograd.grad(image, inputs, cotangent)

    return {"forward": ours, "backward": backward}, {"forward": theirs, "backward": backward}


def kept_rows(size: common.Size) -> list[common.Row]:
    """One row: a frame that was deformed before. What deformed it does not matter."""
    splats, camera = scenes.splats(size)
    playback, background = Playback(scenes.scene(splats, (camera,), preset("default").fitted(68))), torch.zeros(3)

    @torch.no_grad()
    def step(_: object) -> RenderOutput:
        return plain.rasterize(playback.splats(0), camera, background=background)

    theirs = {"": step} if size.num <= TORCH_MOST else None
    result = common.race({"": lambda _: playback.render(0)}, theirs)
    return common.rows("rendering kept frame", result, size.num, (size.width, size.height))


def torch_rendering(scene: SingleScene) -> common.Steps:
    gaussians, field, cfg = scene.gaussians, scene.field, scene.config

    @torch.no_grad()
    def step(_: object) -> RenderOutput:
        if isinstance(field, HexPlaneField):
            offsets = field.offsets(gaussians["means"], TIME, TORCH)
        else:
            offsets = basis_offsets(gaussians.tensors, TIME, cfg, TORCH)
        splats = gaussians.splats(offsets, cfg.schedule.sh_degree)
        return plain.rasterize(splats, scene.cameras[0], background=torch.zeros(3))

    return {"": step}
