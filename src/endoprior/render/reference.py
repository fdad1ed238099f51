"""The reference implementation: every Gaussian at every pixel, in plain PyTorch, differentiated by autograd.

Memory is H x W x N numbers several times over: for small scenes, tests and reading. float32 or float64.
"""

from __future__ import annotations

import torch
from torch import Tensor

from ..core.geometry import pixel_centers
from ..core.types import Camera, RenderOutput, Splats
from .constants import ALPHA_MAX, ALPHA_MIN, STOP_TRANSMITTANCE
from .projection import check, project


def rasterize(splats: Splats, camera: Camera, *, background: Tensor, depth_grad_to_means: bool = True) -> RenderOutput:
    """Render the Gaussians near to far (Kerbl et al. 2023, Eq. 3); ties keep their order. See `render.Rasterizer`."""
    check(splats, background)
    seen = project(splats, camera)
    assert seen.det is not None
    order = seen.z.argsort(stable=True)
    order = order[seen.radii[order] > 0]
    alpha = _alpha(seen.means2d[order], seen.cov2d[order], seen.det[order], splats.opacities[order], camera)
    alpha = alpha * _counts(alpha)
    colors = seen.colors[order] + torch.einsum(
        "hwni,nic->hwnc", _offsets(seen.means2d[order], camera), seen.color_slopes2d[order]
    )
    behind = torch.cumprod(torch.cat([alpha.new_ones((*alpha.shape[:2], 1)), 1 - alpha], -1), -1)
    weights, transmittance = alpha * behind[..., :-1], behind[..., -1]
    z = seen.z if depth_grad_to_means else seen.z.detach()
    return RenderOutput(
        color=(weights[..., None] * colors).sum(2) + transmittance[..., None] * background,
        alpha=1 - transmittance,
        depth=weights @ z[order],
        means2d=seen.means2d,
        radii=seen.radii,
    )


def _alpha(means2d: Tensor, cov2d: Tensor, det: Tensor, opacities: Tensor, camera: Camera) -> Tensor:
    """(H, W, N) opacity times the 2D Gaussian, at most ALPHA_MAX, exactly 0 below ALPHA_MIN."""
    dx, dy = _offsets(means2d, camera).unbind(-1)
    _, xy, yy = cov2d.unbind(-1)
    # Mahalanobis: (yy dx^2 - 2 xy dx dy + xx dy^2) / det, as a sum of squares, which nothing can make negative.
    squared_distance = (dx - xy / yy * dy).square() * (yy / det) + dy * dy / yy
    alpha = (opacities * torch.exp(-0.5 * squared_distance)).clamp(max=ALPHA_MAX)
    return torch.where(alpha >= ALPHA_MIN, alpha, 0)


def _offsets(means2d: Tensor, camera: Camera) -> Tensor:
    """(H, W, N, 2) of each pixel's center from each Gaussian's, px."""
    pixels = torch.as_tensor(pixel_centers(camera.width, camera.height), dtype=means2d.dtype)
    return pixels[:, :, None] - means2d


@torch.no_grad()
def _counts(alpha: Tensor) -> Tensor:
    """(H, W, N) 1 until a Gaussian would bring the transmittance below STOP_TRANSMITTANCE, 0 from that one on."""
    return (torch.cumprod(1 - alpha, -1) >= STOP_TRANSMITTANCE).to(alpha.dtype)
