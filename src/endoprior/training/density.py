"""Adaptive density control guided by the prior: running statistics, and the plan of what to clone, split and remove.

Eqs. (7) and (8) and the pruning rule after them. `plan` only decides; `densify.apply_plan` acts. `N` Gaussians.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field

import torch
from torch import Tensor

from ..core.config import DensityConfig

SCORE_EPS = 1e-6
"""epsilon of Eq. (7)."""


@dataclass
class DensityStats:
    """Sums per Gaussian since the last event (gradient) or since the stage began (score)."""

    grad2d_ndc_sum: Tensor
    """(N,) sum of screen-space gradient norms, NDC units."""
    num_seen: Tensor
    """(N,) times rendered since the last event."""
    score_sum: Tensor
    """(N,) sum of rho at the projected center over valid projections."""
    num_valid: Tensor
    """(N,) n_i: valid projections at which the score was sampled."""
    opacity_sum: Tensor
    """(N,) sum of the opacity at those projections."""

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

    def clear_gradient(self) -> None:
        """Forget the gradients of every Gaussian, as each density event does."""
        self.grad2d_ndc_sum.zero_()
        self.num_seen.zero_()


@dataclass(frozen=True)
class Plan:
    """What one density event does to each of `N` Gaussians; at most one of the three is True."""

    clone: Tensor
    """(N,) bool: a copy is added."""
    split: Tensor
    """(N,) bool: replaced by two smaller children."""
    remove: Tensor
    """(N,) bool: goes."""
    removed_by: Mapping[str, Tensor] = field(default_factory=dict)
    """(N,) bool by rule that can take Gaussians: those that it condemns, whatever becomes of them."""

    def counts(self) -> dict[str, int]:
        """How many are cloned and split, and how many each rule removes."""
        rules = {f"removed_{rule}": self.remove & condemned for rule, condemned in self.removed_by.items()}
        return {name: int(rows.sum()) for name, rows in {"cloned": self.clone, "split": self.split, **rules}.items()}


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
    rules = {"opacity": faint} | ({"size": huge} if cfg.prune_max_scale_mm else {})
    rules |= {"prior": distrusted} if cfg.prior_prune else {}
    return Plan(clone=clone, split=split, remove=remove, removed_by=rules)


def scene_extent(camera_centers: Tensor, points: Tensor, cfg: DensityConfig) -> float:
    """Length that separates small from large Gaussians, mm.

    `camera`: 1.1 times the radius of the camera centers, as 3DGS has it; 0 for a still camera, so nothing is cloned.
    `scene`: 1.1 times the largest distance of a point from the points' centroid; 0 without points.

    Args:
        camera_centers: (T, 3). points: (N, 3).
    """
    cloud = camera_centers if cfg.extent_mode == "camera" else points
    return 1.1 * float((cloud - cloud.mean(0)).norm(dim=-1).max()) if len(cloud) else 0.0
