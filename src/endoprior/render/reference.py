"""The reference implementation: every Gaussian at every pixel, in plain PyTorch, differentiated by autograd.

Memory is H x W x N numbers several times over: for small scenes, tests and reading. float32 or float64.
"""

from __future__ import annotations

from dataclasses import replace

import torch
from torch import Tensor

from ..core.geometry import pixel_centers
from ..core.types import Camera, RenderOutput, Splats
from .constants import ALPHA_MAX, ALPHA_MIN, STOP_TRANSMITTANCE
from .projection import Projected, check, project


def rasterize(splats: Splats, camera: Camera, *, background: Tensor, depth_grad_to_means: bool = True) -> RenderOutput:
    """Render the Gaussians near to far (Kerbl et al. 2023, Eq. 3); ties keep their order. See `render.Rasterizer`."""
    check(splats, background)
    seen = project(splats, camera)
    z = seen.z if depth_grad_to_means else seen.z.detach()
    color, alpha, depth = composite(replace(seen, z=z), splats.opacities, (camera.width, camera.height), background)
    return RenderOutput(color, alpha, depth, seen.means2d, seen.radii)


def composite(
    seen: Projected, opacities: Tensor, size: tuple[int, int], background: Tensor
) -> tuple[Tensor, Tensor, Tensor]:
    """Color (H, W, 3), alpha (H, W) and depth (H, W) of projected Gaussians; `size` is (width, height), px."""
    order = seen.z.argsort(stable=True)
    order = order[seen.radii[order] > 0]
    offsets = _offsets(seen.means2d[order], size)
    alpha = _alpha(offsets, seen.cov2d[order], seen.det[order], opacities[order])
    alpha = alpha * _counts(alpha)
    colors = seen.colors[order] + torch.einsum("hwni,nic->hwnc", offsets, seen.color_slopes2d[order])
    behind = torch.cumprod(torch.cat([alpha.new_ones((*alpha.shape[:2], 1)), 1 - alpha], -1), -1)
    weights, transmittance = alpha * behind[..., :-1], behind[..., -1]
    color = (weights[..., None] * colors).sum(2) + transmittance[..., None] * background
    return color, 1 - transmittance, weights @ seen.z[order]


def _alpha(offsets: Tensor, cov2d: Tensor, det: Tensor, opacities: Tensor) -> Tensor:
    """(H, W, N) opacity times the 2D Gaussian, at most ALPHA_MAX, exactly 0 below ALPHA_MIN."""
    dx, dy = offsets.unbind(-1)
    _, xy, yy = cov2d.unbind(-1)
    # Mahalanobis: (yy dx^2 - 2 xy dx dy + xx dy^2) / det, as a sum of squares, which nothing can make negative.
    squared_distance = (dx - xy / yy * dy).square() * (yy / det) + dy * dy / yy
    alpha = (opacities * torch.exp(-0.5 * squared_distance)).clamp(max=ALPHA_MAX)
    return torch.where(alpha >= ALPHA_MIN, alpha, 0)


def _offsets(means2d: Tensor, size: tuple[int, int]) -> Tensor:
    """(H, W, N, 2) of each pixel's center from each Gaussian's, px."""
    pixels = torch.as_tensor(pixel_centers(*size), dtype=means2d.dtype)
    return pixels[:, :, None] - means2d


@torch.no_grad()
def _counts(alpha: Tensor) -> Tensor:
    """(H, W, N) 1 until a Gaussian would bring the transmittance below STOP_TRANSMITTANCE, 0 from that one on."""
    return (torch.cumprod(1 - alpha, -1) >= STOP_TRANSMITTANCE).to(alpha.dtype)
