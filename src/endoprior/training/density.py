"""Adaptive density control guided by the prior: running statistics, and the plan of what to clone, split and remove.

Eqs. (7) and (8) and the pruning rule after them. `plan` only decides; `optim.apply_plan` acts. `N` Gaussians.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor
from torch.nn.functional import grid_sample

from ..compute.compiled import compiled
from ..core.config import DensityConfig
from ..core.types import RenderOutput
from . import density_kernels as kernels

SCORE_EPS = 1e-6
"""epsilon of Eq. (7)."""


@dataclass
class DensityStats:
    """Sums per Gaussian since the last event (gradient) or since the stage began (score)."""

    grad2d_ndc_sum: Tensor
    """(N,) sum of screen-space gradient norms, NDC units."""
    num_seen: Tensor
    """(N,) times drawn since the last event."""
    score_sum: Tensor
    """(N,) sum of rho at the projected center over valid projections."""
    num_valid: Tensor
    """(N,) n_i: valid projections at which the score was sampled."""
    opacity_sum: Tensor
    """(N,) sum of the opacity at those moments."""

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

    def add_gradient(self, out: RenderOutput, width: int, height: int, frozen: Tensor | None = None) -> None:
        """Add one rendering's screen-space gradient, after backward; Gaussians that were not drawn are left alone.

        Args:
            width, height: of the picture, px.
            frozen: () on a device; where it is not 0, nothing is added.
        """
        if not compiled(out.radii):
            counted = _counted(out.radii > 0, frozen)
            x, y = out.means2d.grad.unbind(-1)
            self.grad2d_ndc_sum += torch.where(counted, torch.hypot(x * (width / 2), y * (height / 2)), 0)
            self.num_seen += counted
            return
        gradient = out.means2d.grad.contiguous().numpy()
        half = np.float32(width / 2), np.float32(height / 2)
        kernels.add_gradient(out.radii.numpy(), gradient, *half, self.grad2d_ndc_sum.numpy(), self.num_seen.numpy())

    def add_score(
        self,
        out: RenderOutput,
        prior: Tensor,
        tissue_mask: Tensor,
        opacities: Tensor,
        scale: float = 1.0,
        frozen: Tensor | None = None,
    ) -> None:
        """Sample rho where the drawn centers fall on tissue: s_it and m_it of Eq. (7).

        Args:
            prior: (H, W) rho in [0, 1]. tissue_mask: (H, W) bool, True on tissue. opacities: (N,) canonical.
            scale: pixels of `prior` per pixel of the rendering.
            frozen: as in `add_gradient`.
        """
        if not compiled(out.radii):
            at = scale * out.means2d.detach()
            counted = _counted(valid_projection(at, out.radii, tissue_mask), frozen)
            self.score_sum += torch.where(counted, _sample(prior, at), 0)
            self.opacity_sum += torch.where(counted, opacities.detach(), 0)
            self.num_valid += counted
            return
        kernels.add_score(
            *_projections(out.means2d, out.radii), np.float32(scale), prior.numpy(), tissue_mask.numpy(),
            opacities.detach().numpy(), self.score_sum.numpy(), self.opacity_sum.numpy(), self.num_valid.numpy(),
        )  # fmt: skip

    def clear_gradient(self) -> None:
        """Forget the gradients of every Gaussian, as each density event does."""
        self.grad2d_ndc_sum.zero_()
        self.num_seen.zero_()


def valid_projection(means2d: Tensor, radii: Tensor, tissue_mask: Tensor) -> Tensor:
    """(N,) bool m_it of Eq. (7): drawn, inside the image, and on tissue (interpolated mask above one half).

    Args:
        means2d: (N, 2) px. radii: (N,) px, 0 where not drawn. tissue_mask: (H, W) bool, True on tissue.
    """
    if not compiled(radii):
        height, width = tissue_mask.shape
        x, y = means2d.detach().unbind(-1)
        inside = (x >= 0) & (x <= width) & (y >= 0) & (y <= height)
        return (radii > 0) & inside & (_sample(tissue_mask.float(), means2d.detach()) > 0.5)
    found = np.empty(len(radii), np.bool_)
    kernels.valid(*_projections(means2d, radii), tissue_mask.numpy(), found)
    return torch.from_numpy(found)


def _counted(drawn: Tensor, frozen: Tensor | None) -> Tensor:
    """(N,) bool `drawn`, or False everywhere when the run is frozen."""
    return drawn if frozen is None else drawn & (frozen == 0)


def _sample(image: Tensor, means2d: Tensor) -> Tensor:
    """(N,) bilinear values of an (H, W) image at (N, 2) px; centers at half integers, border repeated, NaN for NaN."""
    height, width = image.shape
    x, y = means2d.unbind(-1)
    where = torch.stack([2 * x / width - 1, 2 * y / height - 1], -1)
    found = grid_sample(image[None, None], where[None, None], padding_mode="border", align_corners=False)
    return found[0, 0, 0]


def _projections(means2d: Tensor, radii: Tensor) -> tuple[NDArray[np.float32], NDArray[np.int32]]:
    return means2d.detach().contiguous().numpy(), radii.contiguous().numpy()


@dataclass(frozen=True)
class Plan:
    """What one density event does to each of `N` Gaussians; at most one of the three is True."""

    clone: Tensor
    """(N,) bool: a copy is added."""
    split: Tensor
    """(N,) bool: replaced by two smaller children."""
    remove: Tensor
    """(N,) bool: goes."""


def due(iteration: int, is_last_of_fine: bool, cfg: DensityConfig) -> bool:
    """Whether a density event follows this iteration (1-based, counted within the stage)."""
    inside = cfg.start_iteration < iteration < cfg.stop_iteration
    return inside and iteration % cfg.every == 0 and not is_last_of_fine


def densify_weight(score: Tensor, cfg: DensityConfig) -> Tensor:
    """(N,) factor of the gradient in Eq. (8): lambda_min + (1 - lambda_min) s."""
    floor = cfg.min_densify_weight
    return floor + (1 - floor) * score


def plan(stats: DensityStats, scales: Tensor, opacities: Tensor, extent: float, cfg: DensityConfig) -> Plan:
    """Choose what to clone, split and remove: Eq. (8), the prior prune, and 3DGS's rules. Pure.

    Args:
        scales: (N, 3) canonical, mm. opacities: (N,) canonical. extent: scene extent, mm.
    """
    score = stats.score(cfg.unobserved_score)
    gradient = stats.grad2d_ndc_sum / stats.num_seen.clamp(min=1)
    largest = scales.amax(-1)
    faint = opacities < cfg.prune_opacity
    huge = largest > cfg.prune_max_scale_mm if cfg.prune_max_scale_mm > 0 else torch.zeros_like(faint)
    distrusted = torch.zeros_like(faint)
    if cfg.prior_prune:
        distrusted = (
            (stats.num_valid >= cfg.min_valid)
            & (score < cfg.prior_threshold)
            & (stats.mean_opacity(opacities) < cfg.prior_opacity)
        )
    grow = (densify_weight(score, cfg) * gradient >= cfg.grow_threshold) & ~faint
    small = largest <= cfg.clone_extent * extent
    # Pruning follows growth: children are smaller and unobserved, so only their size can condemn them.
    children_huge = huge & (largest / cfg.split_shrink > cfg.prune_max_scale_mm)
    split = grow & ~small & ~children_huge
    clone = grow & small & ~huge & ~distrusted
    remove = (faint | huge | distrusted) & ~split
    if len(scales) + int(clone.sum()) + int(split.sum()) - int(remove.sum()) > cfg.max_gaussians:
        clone, split = torch.zeros_like(clone), torch.zeros_like(split)
        remove = faint | huge | distrusted
    return Plan(clone=clone, split=split, remove=remove)


def scene_extent(camera_centers: Tensor, points: Tensor, cfg: DensityConfig) -> float:
    """Length that separates small from large Gaussians, mm.

    `camera`: 1.1 times the radius of the camera centers, as 3DGS has it; 0 for a still camera, so nothing is cloned.
    `scene`: 1.1 times the largest distance of a point from the points' centroid; 0 without points.

    Args:
        camera_centers: (T, 3). points: (N, 3).
    """
    cloud = camera_centers if cfg.extent_mode == "camera" else points
    return 1.1 * float((cloud - cloud.mean(0)).norm(dim=-1).max()) if len(cloud) else 0.0
