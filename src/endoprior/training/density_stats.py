"""Running statistics of density control, Eq. (7): gathered in PyTorch, on any device, and in Numba for the CPU.

`skip` is a () float32 tensor on the device, or None: where it is not 0, nothing is added (`divergence.py`). On a CPU it
has no use: the check comes first. `N` Gaussians. Kernels take C-contiguous arrays and trust them: `means2d` (N, 2)
float32 px, `radii` (N,) int32 px and 0 where a Gaussian is not rendered, `tissue_mask` (H, W) bool, sums (N,) float32.
"""

# pyright: reportCallIssue=false
from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import torch
from numba import njit, prange
from torch import Tensor
from torch.nn.functional import grid_sample

from ..compute.parallel_kernels import parallel_njit
from ..core.types import RenderOutput
from .adam import gradient_of

SCORE_EPS = 1e-6  # epsilon of Eq. (7)
_CHUNK = 1024  # Gaussians per task
_HALF = np.float32(0.5)
_ONE = np.float32(1)


@dataclass
class DensityStats:
    """Sums per Gaussian since the last event (gradient) or since the stage began (score)."""

    grad2d_ndc_sum: Tensor  # (N,) sum of screen-space gradient norms, NDC units
    num_seen: Tensor  # (N,) times rendered since the last event
    score_sum: Tensor  # (N,) sum of rho at the projected center over valid projections
    num_valid: Tensor  # (N,) n_i: valid projections at which the score was sampled
    opacity_sum: Tensor  # (N,) sum of the opacity at those projections

    @staticmethod
    def zeros(num: int, device: torch.device | str = "cpu") -> DensityStats:
        """Statistics of `num` Gaussians of which nothing is known."""
        return DensityStats(*(torch.zeros(num, device=device) for _ in range(5)))

    def tensors(self) -> dict[str, Tensor]:
        """The sums by name."""
        return dict(vars(self))

    def score(self, unobserved: float) -> Tensor:
        """(N,) texture-prior score s in [0, 1], Eq. (7); `unobserved` where nothing was sampled."""
        mean = self.score_sum / (self.num_valid + SCORE_EPS)
        return torch.where(self.num_valid > 0, mean, unobserved)

    def mean_opacity(self, current: Tensor) -> Tensor:
        """(N,) running mean opacity; the `current` one where nothing was sampled."""
        return torch.where(self.num_valid > 0, self.opacity_sum / self.num_valid.clamp(min=1), current)


def add_gradient(stats: DensityStats, out: RenderOutput, width: int, height: int, skip: Tensor | None = None) -> None:
    """Add the screen-space gradient of one image, after backward; Gaussians that were not rendered keep their sums."""
    counted = _counted(out.radii > 0, skip)
    x, y = gradient_of(out.means2d).unbind(-1)
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
        prior: (H, W) rho in [0, 1]. opacities: (N,) canonical. scale: pixels of `prior` per pixel of the image.
    """
    at = scale * out.means2d.detach()
    counted = _counted(valid_projection(at, out.radii, tissue_mask), skip)
    stats.score_sum += torch.where(counted, _sample(prior, at), 0)
    stats.opacity_sum += torch.where(counted, opacities.detach(), 0)
    stats.num_valid += counted


def valid_projection(means2d: Tensor, radii: Tensor, tissue_mask: Tensor) -> Tensor:
    """(N,) bool m_it of Eq. (7): rendered, inside the image, and on tissue (interpolated mask above one half).

    Args:
        means2d: (N, 2) px. radii: (N,) px, 0 where not rendered.
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


def add_gradient_numba(stats: DensityStats, out: RenderOutput, width: int, height: int, _skip: None = None) -> None:
    """See `add_gradient`."""
    gradient, half = gradient_of(out.means2d).numpy(), (np.float32(width / 2), np.float32(height / 2))
    _add_gradient(out.radii.numpy(), gradient, *half, stats.grad2d_ndc_sum.numpy(), stats.num_seen.numpy())


def add_score_numba(
    stats: DensityStats,
    out: RenderOutput,
    prior: Tensor,
    tissue_mask: Tensor,
    opacities: Tensor,
    scale: float = 1.0,
    _skip: None = None,
) -> None:
    """See `add_score`."""
    means2d, radii = out.means2d.detach().contiguous().numpy(), out.radii.contiguous().numpy()
    images, sums = (prior, tissue_mask, opacities.detach()), (stats.score_sum, stats.opacity_sum, stats.num_valid)
    _add_score(means2d, radii, np.float32(scale), *(tensor.numpy() for tensor in (*images, *sums)))


def valid_projection_numba(means2d: Tensor, radii: Tensor, tissue_mask: Tensor) -> Tensor:
    """See `valid_projection`."""
    found = np.empty(len(radii), np.bool_)
    _valid(means2d.detach().contiguous().numpy(), radii.contiguous().numpy(), tissue_mask.numpy(), found)
    return torch.from_numpy(found)


@parallel_njit()
def _add_gradient(radii, v_means2d, half_width, half_height, grad2d_ndc_sum, num_seen):
    # Add the norm of the gradient (N, 2) in NDC units, and 1 to `num_seen`, where rendered.
    num = len(radii)
    for task in prange((num + _CHUNK - 1) // _CHUNK):
        for n in range(task * _CHUNK, min(num, (task + 1) * _CHUNK)):
            if radii[n] > 0:
                x, y = v_means2d[n, 0] * half_width, v_means2d[n, 1] * half_height
                grad2d_ndc_sum[n] += np.sqrt(x * x + y * y)
                num_seen[n] += _ONE


@parallel_njit()
def _add_score(means2d, radii, scale, prior, tissue_mask, opacities, score_sum, opacity_sum, num_valid):
    # Add the prior (H, W) at `scale * means2d`, the opacity (N,) and 1, where `_is_valid` says so.
    num = len(radii)
    for task in prange((num + _CHUNK - 1) // _CHUNK):
        for n in range(task * _CHUNK, min(num, (task + 1) * _CHUNK)):
            x, y = scale * means2d[n, 0], scale * means2d[n, 1]
            if _is_valid(x, y, radii[n], tissue_mask):
                score_sum[n] += _interpolated(prior, x, y)
                opacity_sum[n] += opacities[n]
                num_valid[n] += _ONE


@parallel_njit()
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
    return radius > 0 and inside and _interpolated(tissue_mask, x, y) > _HALF


@njit(inline="always")
def _interpolated(image, x, y):
    # Bilinear value at pixel (x, y) inside the image; pixel centers at half integers, border repeated.
    height, width = image.shape
    u, v = max(x - _HALF, np.float32(0)), max(y - _HALF, np.float32(0))
    left, top = min(int(u), width - 1), min(int(v), height - 1)
    right, bottom = min(left + 1, width - 1), min(top + 1, height - 1)
    fx, fy = min(u - np.float32(left), _ONE), min(v - np.float32(top), _ONE)
    above = (_ONE - fx) * np.float32(image[top, left]) + fx * np.float32(image[top, right])
    below = (_ONE - fx) * np.float32(image[bottom, left]) + fx * np.float32(image[bottom, right])
    return (_ONE - fy) * above + fy * below
