"""The two differentiable operations of a rasterizer, on the kernels of a backend.

`means2d` lies between them, so that its gradient can be kept. In kernels and here, `v_x` is dL/dx.

Kernels take a 2D Gaussian as the factors (a, k, m) of its conic, the inverse covariance: conic = L D L^T with
D = diag(a, m) and k below the diagonal of L. Unlike the conic's own entries they do not cancel. A backend chooses which
image axis comes first. Shared letters: `N` Gaussians, `K` SH coefficients, `H, W` image.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import torch
from torch import Tensor
from torch.autograd.function import once_differentiable

from ..core.types import Camera, RenderOutput, Splats
from .projection import color_slopes

Tensors = tuple[Tensor, ...]


@dataclass(frozen=True)
class Kernels:
    """What a backend computes. All tensors are float32, contiguous, on one device, and trusted.

    3D Gaussians are means, quats, scales, sh, color_slopes; 2D ones means2d (N, 2), conic_ldl (N, 3), z (N,),
    colors (N, 3), color_slopes2d (N, 2, 3), opacities (N,). Images are color (H, W, 3), depth and transmittance (H, W);
    their cotangents those of color, depth and alpha. A size is (width, height), px.
    """

    project_forward: Callable[[Tensors, Tensor, Camera], Tensors]
    """3D Gaussians, opacities -> 2D Gaussians without opacities, radii (N,) int32; zeros where culled."""
    project_backward: Callable[[Tensors, Camera, Tensor, Tensors], Tensors]
    """3D Gaussians, camera, radii, cotangents of the 2D Gaussians -> gradients; zeros where the radius is 0."""
    bin_tiles: Callable[[Tensors, Tensor, tuple[int, int]], Any]
    """2D Gaussians, radii, size -> the Gaussians that touch each tile, near to far, as the next two take them."""
    composite_forward: Callable[[Any, Tensor, tuple[int, int]], tuple[Tensor, Tensor, Tensor, Any]]
    """Tiles, background (3,), size -> images, and where each tile's list was left."""
    composite_backward: Callable[[Any, Any, Tensor, Tensor, Tensor, Tensors, Tensors], Tensors]
    """Tiles, where their lists were left, conic_ldl, color_slopes2d, opacities, images, cotangents -> gradients of 2D
    Gaussians."""


def empty_gaussians2d(like: Tensor, num: int) -> Tensors:
    """Uninitialized means2d, conic_ldl, z, colors and color_slopes2d of `num` Gaussians, on the device of a tensor."""
    return tuple(like.new_empty(shape) for shape in ((num, 2), (num, 3), (num,), (num, 3), (num, 2, 3)))


def empty_images(like: Tensor, size: tuple[int, int]) -> tuple[Tensor, Tensor, Tensor]:
    """Uninitialized color, depth and transmittance of an image of that size, on the device of a tensor."""
    shape = size[::-1]
    return like.new_empty((*shape, 3)), like.new_empty(shape), like.new_empty(shape)


def rasterize_with(
    kernels: Kernels, splats: Splats, camera: Camera, background: Tensor, depth_grad_to_means: bool
) -> RenderOutput:
    """Render checked Gaussians with a backend's kernels. See `render.Rasterizer`."""
    gaussians = (splats.means, splats.quats, splats.scales, splats.sh, color_slopes(splats))
    means2d, conic_ldl, z, colors, color_slopes2d, radii = Project.apply(
        kernels, camera, splats.opacities.detach(), *gaussians
    )
    z = z if depth_grad_to_means else z.detach()
    size = (camera.width, camera.height)
    gaussians = (means2d, conic_ldl, z, colors, color_slopes2d, splats.opacities)
    color, alpha, depth = Composite.apply(kernels, size, radii, background, *gaussians)
    return RenderOutput(color, alpha, depth, means2d, radii)


class Project(torch.autograd.Function):
    """3D Gaussians -> means2d, conic_ldl, z, colors, color_slopes2d, radii. Opacities only decide what is visible."""

    @staticmethod
    def forward(ctx: Any, kernels: Kernels, camera: Camera, opacities: Tensor, *gaussians: Tensor) -> Tensors:
        gaussians = tuple(tensor.contiguous() for tensor in gaussians)
        outputs = kernels.project_forward(gaussians, opacities.contiguous(), camera)
        ctx.save_for_backward(*gaussians, outputs[-1])
        ctx.kernels, ctx.camera = kernels, camera
        ctx.mark_non_differentiable(outputs[-1])
        return outputs

    @staticmethod
    @once_differentiable
    def backward(ctx: Any, *cotangents: Tensor) -> tuple[Tensor | None, ...]:
        *gaussians, radii = ctx.saved_tensors
        contiguous = tuple(v.contiguous() for v in cotangents[:-1])
        return None, None, None, *ctx.kernels.project_backward(tuple(gaussians), ctx.camera, radii, contiguous)


class Composite(torch.autograd.Function):
    """2D Gaussians -> color (H, W, 3), alpha (H, W), depth (H, W)."""

    @staticmethod
    def forward(
        ctx: Any, kernels: Kernels, size: tuple[int, int], radii: Tensor, background: Tensor, *gaussians: Tensor
    ) -> tuple[Tensor, Tensor, Tensor]:
        gaussians = tuple(tensor.contiguous() for tensor in gaussians)
        tiles = kernels.bin_tiles(gaussians, radii, size)
        color, depth, transmittance, tile_ends = kernels.composite_forward(tiles, background.contiguous(), size)
        ctx.save_for_backward(gaussians[1], gaussians[4], gaussians[5], color, depth, transmittance)
        ctx.kernels, ctx.tiles, ctx.tile_ends = kernels, tiles, tile_ends
        return color, 1 - transmittance, depth

    @staticmethod
    @once_differentiable
    def backward(ctx: Any, v_color: Tensor, v_alpha: Tensor, v_depth: Tensor) -> tuple[Tensor | None, ...]:
        conic_ldl, color_slopes2d, opacities, *images = ctx.saved_tensors
        cotangents = tuple(v.contiguous() for v in (v_color, v_depth, v_alpha))
        lists = (ctx.tiles, ctx.tile_ends)
        grads = ctx.kernels.composite_backward(*lists, conic_ldl, color_slopes2d, opacities, tuple(images), cotangents)
        v_background = (v_color * images[2][..., None]).sum((0, 1)) if ctx.needs_input_grad[3] else None
        return None, None, None, v_background, *grads
