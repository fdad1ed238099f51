"""The two differentiable operations of a rasterizer, on the kernels of any backend.

`means2d` lies between them, so that its gradient can be kept. In kernels and here, `v_x` is dL/dx.

Kernels take a 2D Gaussian as the factors (a, k, m) of its conic, the inverse covariance: conic = L D L^T with
D = diag(a, m) and k below the diagonal of L. Unlike the conic's own entries they do not cancel. A backend chooses which
image axis comes first. Shared letters: `N` Gaussians, `K` SH coefficients, `H, W` image.
"""

from __future__ import annotations

from typing import Any, Protocol

import torch
from torch import Tensor
from torch.autograd.function import once_differentiable

from ..core.types import Camera, RenderOutput, Splats


class Kernels(Protocol):
    """What a backend computes. All tensors are float32, contiguous and on its device, and trusted."""

    def project_forward(
        self, means: Tensor, quats: Tensor, scales: Tensor, sh: Tensor, opacities: Tensor, camera: Camera
    ) -> tuple[Tensor, Tensor, Tensor, Tensor, Tensor]:
        """means2d (N, 2), conic_ldl (N, 3), z (N,), colors (N, 3), radii (N,) int32; zeros where culled.

        `opacities` only decide what is visible.
        """
        ...

    def project_backward(
        self, inputs: tuple[Tensor, ...], camera: Camera, radii: Tensor, cotangents: tuple[Tensor, ...]
    ) -> tuple[Tensor, Tensor, Tensor, Tensor]:
        """Gradients of `inputs`, which are means, quats, scales and sh; zeros where `radii` is 0.

        `cotangents` are those of means2d, conic_ldl, z and colors.
        """
        ...

    def bin_tiles(
        self,
        means2d: Tensor,
        conic_ldl: Tensor,
        z: Tensor,
        colors: Tensor,
        opacities: Tensor,
        radii: Tensor,
        size: tuple[int, int],
    ) -> Any:
        """Lists of the Gaussians that touch each tile, near to far, as the next two take them. `size`: (W, H), px."""
        ...

    def composite_forward(
        self, tiles: Any, background: Tensor, size: tuple[int, int]
    ) -> tuple[Tensor, Tensor, Tensor, Any]:
        """color (H, W, 3), depth (H, W), transmittance (H, W), and where each tile's list was left."""
        ...

    def composite_backward(
        self,
        tiles: Any,
        tile_ends: Any,
        conic_ldl: Tensor,
        opacities: Tensor,
        images: tuple[Tensor, ...],
        cotangents: tuple[Tensor, ...],
    ) -> tuple[Tensor, Tensor, Tensor, Tensor, Tensor]:
        """Gradients of means2d, conic_ldl, z, colors and opacities.

        `images` are color, depth and transmittance; `cotangents` those of color, depth and alpha.
        """
        ...


def rasterize_with(
    kernels: Kernels, splats: Splats, camera: Camera, background: Tensor, depth_grad_to_means: bool
) -> RenderOutput:
    """Render checked Gaussians with a backend's kernels. See `render.Rasterizer`."""
    means2d, conic_ldl, z, colors, radii = Project.apply(
        splats.means, splats.quats, splats.scales, splats.sh, splats.opacities.detach(), camera, kernels
    )
    z = z if depth_grad_to_means else z.detach()
    size = (camera.width, camera.height)
    color, alpha, depth = Composite.apply(
        means2d, conic_ldl, z, colors, splats.opacities, background, radii, size, kernels
    )
    return RenderOutput(color, alpha, depth, means2d, radii)


class Project(torch.autograd.Function):
    """3D Gaussians -> means2d (N, 2), conic_ldl (N, 3), z (N,), colors (N, 3), radii (N,) int32."""

    @staticmethod
    def forward(
        ctx: Any,
        means: Tensor,
        quats: Tensor,
        scales: Tensor,
        sh: Tensor,
        opacities: Tensor,
        camera: Camera,
        kernels: Kernels,
    ) -> tuple[Tensor, ...]:
        """Project, and evaluate the colors."""
        inputs = [tensor.contiguous() for tensor in (means, quats, scales, sh)]
        outputs = kernels.project_forward(*inputs, opacities.contiguous(), camera)
        radii = outputs[-1]
        ctx.save_for_backward(*inputs, radii)
        ctx.camera, ctx.kernels = camera, kernels
        ctx.mark_non_differentiable(radii)
        return outputs

    @staticmethod
    @once_differentiable
    def backward(ctx: Any, *cotangents: Tensor) -> tuple[Tensor | None, ...]:
        """Chain rule through projection and colors."""
        *inputs, radii = ctx.saved_tensors
        contiguous = tuple(v.contiguous() for v in cotangents[:-1])
        return *ctx.kernels.project_backward(tuple(inputs), ctx.camera, radii, contiguous), None, None, None


class Composite(torch.autograd.Function):
    """2D Gaussians -> color (H, W, 3), alpha (H, W), depth (H, W)."""

    @staticmethod
    def forward(
        ctx: Any,
        means2d: Tensor,
        conic_ldl: Tensor,
        z: Tensor,
        colors: Tensor,
        opacities: Tensor,
        background: Tensor,
        radii: Tensor,
        size: tuple[int, int],
        kernels: Kernels,
    ) -> tuple[Tensor, Tensor, Tensor]:
        """Sort into tiles and blend. `size` is (width, height), px."""
        opacities = opacities.contiguous()
        tiles = kernels.bin_tiles(means2d, conic_ldl, z, colors, opacities, radii, size)
        color, depth, transmittance, tile_ends = kernels.composite_forward(tiles, background.contiguous(), size)
        ctx.save_for_backward(conic_ldl, opacities, color, depth, transmittance)
        ctx.tiles, ctx.tile_ends, ctx.kernels = tiles, tile_ends, kernels
        return color, 1 - transmittance, depth

    @staticmethod
    @once_differentiable
    def backward(ctx: Any, v_color: Tensor, v_alpha: Tensor, v_depth: Tensor) -> tuple[Tensor | None, ...]:
        """Chain rule through the blending."""
        conic_ldl, opacities, *images = ctx.saved_tensors
        cotangents = tuple(v.contiguous() for v in (v_color, v_depth, v_alpha))
        grads = ctx.kernels.composite_backward(
            ctx.tiles, ctx.tile_ends, conic_ldl, opacities, tuple(images), cotangents
        )
        v_background = (v_color * images[2][..., None]).sum((0, 1)) if ctx.needs_input_grad[5] else None
        return *grads, v_background, None, None, None
