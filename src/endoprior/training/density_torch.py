"""Per-Gaussian statistics of one rendered image in PyTorch, on any device. `N` Gaussians.

`skip` is a () float32 tensor on the device, or None: where it is not 0, nothing is added (`divergence.py`).
"""

from __future__ import annotations

import torch
from torch import Tensor
from torch.nn.functional import grid_sample

from ..core.types import RenderOutput
from .density import DensityStats


def add_gradient(stats: DensityStats, out: RenderOutput, width: int, height: int, skip: Tensor | None = None) -> None:
    """Add the screen-space gradient of one image, after backward; Gaussians that were not rendered keep their sums.

    Args:
        width, height: of the image, px.
    """
    counted = _counted(out.radii > 0, skip)
    x, y = out.means2d.grad.unbind(-1)
    stats.grad2d_ndc_sum += torch.where(counted, torch.hypot(x * (width / 2), y * (height / 2)), 0)
    stats.num_seen += counted


def add_score(
    stats: DensityStats,
    out: RenderOutput,
    prior: Tensor,
    tissue_mask: Tensor,
    opacities: Tensor,
    scale: float = 1.0,
    skip: Tensor | None = None,
) -> None:
    """Sample rho where the rendered centers fall on tissue: s_it and m_it of Eq. (7).

    Args:
        prior: (H, W) rho in [0, 1]. tissue_mask: (H, W) bool, True on tissue. opacities: (N,) canonical.
        scale: pixels of `prior` per pixel of the image.
    """
    at = scale * out.means2d.detach()
    counted = _counted(valid_projection(at, out.radii, tissue_mask), skip)
    stats.score_sum += torch.where(counted, _sample(prior, at), 0)
    stats.opacity_sum += torch.where(counted, opacities.detach(), 0)
    stats.num_valid += counted


def valid_projection(means2d: Tensor, radii: Tensor, tissue_mask: Tensor) -> Tensor:
    """(N,) bool m_it of Eq. (7): rendered, inside the image, and on tissue (interpolated mask above one half).

    Args:
        means2d: (N, 2) px. radii: (N,) px, 0 where not rendered. tissue_mask: (H, W) bool, True on tissue.
    """
    height, width = tissue_mask.shape
    x, y = means2d.detach().unbind(-1)
    inside = (x >= 0) & (x <= width) & (y >= 0) & (y <= height)
    return (radii > 0) & inside & (_sample(tissue_mask.float(), means2d.detach()) > 0.5)


def _counted(rendered: Tensor, skip: Tensor | None) -> Tensor:
    return rendered if skip is None else rendered & (skip == 0)


def _sample(image: Tensor, means2d: Tensor) -> Tensor:
    """(N,) bilinear values of an (H, W) image at (N, 2) px; centers at half integers, border repeated, NaN for NaN."""
    height, width = image.shape
    x, y = means2d.unbind(-1)
    where = torch.stack([2 * x / width - 1, 2 * y / height - 1], -1)
    found = grid_sample(image[None, None], where[None, None], padding_mode="border", align_corners=False)
    return found[0, 0, 0]
