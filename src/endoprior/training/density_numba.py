"""Per-Gaussian statistics of one rendered image in Numba, in one pass over the Gaussians. CPU, float32.

Kernels take C-contiguous arrays and trust them: `means2d` (N, 2) float32 px, `radii` (N,) int32 px and 0 where a
Gaussian is not rendered, `tissue_mask` (H, W) bool, sums (N,) float32. `_skip` has no use here: on a CPU the divergence
check comes first.
"""

from __future__ import annotations

import numpy as np
import torch
from numba import njit, prange
from torch import Tensor

from ..core.types import RenderOutput
from .adam import gradient_of
from .density import DensityStats

_CHUNK = 1024  # Gaussians per task
_HALF = np.float32(0.5)
_ONE = np.float32(1)


def add_gradient(stats: DensityStats, out: RenderOutput, width: int, height: int, _skip: None = None) -> None:
    """See `density.add_gradient`."""
    gradient, half = gradient_of(out.means2d).numpy(), (np.float32(width / 2), np.float32(height / 2))
    _add_gradient(out.radii.numpy(), gradient, *half, stats.grad2d_ndc_sum.numpy(), stats.num_seen.numpy())


def add_score(
    stats: DensityStats,
    out: RenderOutput,
    prior: Tensor,
    tissue_mask: Tensor,
    opacities: Tensor,
    scale: float = 1.0,
    _skip: None = None,
) -> None:
    """See `density.add_score`."""
    means2d, radii = out.means2d.detach().contiguous().numpy(), out.radii.contiguous().numpy()
    images, sums = (prior, tissue_mask, opacities.detach()), (stats.score_sum, stats.opacity_sum, stats.num_valid)
    _add_score(means2d, radii, np.float32(scale), *(tensor.numpy() for tensor in (*images, *sums)))


def valid_projection(means2d: Tensor, radii: Tensor, tissue_mask: Tensor) -> Tensor:
    """See `density.valid_projection`."""
    found = np.empty(len(radii), np.bool_)
    _valid(means2d.detach().contiguous().numpy(), radii.contiguous().numpy(), tissue_mask.numpy(), found)
    return torch.from_numpy(found)


@njit(parallel=True, cache=True)
def _add_gradient(radii, v_means2d, half_width, half_height, grad2d_ndc_sum, num_seen):
    # Add the norm of the gradient (N, 2) in NDC units, and 1 to `num_seen`, where rendered.
    num = len(radii)
    for task in prange((num + _CHUNK - 1) // _CHUNK):
        for n in range(task * _CHUNK, min(num, (task + 1) * _CHUNK)):
            if radii[n] > 0:
                x, y = v_means2d[n, 0] * half_width, v_means2d[n, 1] * half_height
                grad2d_ndc_sum[n] += np.sqrt(x * x + y * y)
                num_seen[n] += _ONE


@njit(parallel=True, cache=True)
def _add_score(means2d, radii, scale, prior, tissue_mask, opacities, score_sum, opacity_sum, num_valid):
    # Add the prior (H, W) at `scale * means2d`, the opacity (N,) and 1, where `_is_valid` says so.
    num = len(radii)
    for task in prange((num + _CHUNK - 1) // _CHUNK):
        for n in range(task * _CHUNK, min(num, (task + 1) * _CHUNK)):
            x, y = scale * means2d[n, 0], scale * means2d[n, 1]
            if _is_valid(x, y, radii[n], tissue_mask):
                score_sum[n] += _sample(prior, x, y)
                opacity_sum[n] += opacities[n]
                num_valid[n] += _ONE


@njit(parallel=True, cache=True)
def _valid(means2d, radii, tissue_mask, found):
    # Write `_is_valid` of every Gaussian to `found` (N,) bool.
    num = len(radii)
    for task in prange((num + _CHUNK - 1) // _CHUNK):
        for n in range(task * _CHUNK, min(num, (task + 1) * _CHUNK)):
            found[n] = _is_valid(means2d[n, 0], means2d[n, 1], radii[n], tissue_mask)


@njit(inline="always")
def _is_valid(x, y, radius, tissue_mask):
    # m_it of Eq. (7): rendered, inside the image, and on tissue (interpolated mask above one half); NaN is not.
    height, width = tissue_mask.shape
    inside = x >= 0 and x <= width and y >= 0 and y <= height
    return radius > 0 and inside and _sample(tissue_mask, x, y) > _HALF


@njit(inline="always")
def _sample(image, x, y):
    # Bilinear value at pixel (x, y) inside the image; pixel centers at half integers, border repeated.
    height, width = image.shape
    u, v = max(x - _HALF, np.float32(0)), max(y - _HALF, np.float32(0))
    left, top = min(int(u), width - 1), min(int(v), height - 1)
    right, bottom = min(left + 1, width - 1), min(top + 1, height - 1)
    fx, fy = min(u - np.float32(left), _ONE), min(v - np.float32(top), _ONE)
    above = (_ONE - fx) * np.float32(image[top, left]) + fx * np.float32(image[top, right])
    below = (_ONE - fx) * np.float32(image[bottom, left]) + fx * np.float32(image[bottom, right])
    return (_ONE - fy) * above + fy * below
