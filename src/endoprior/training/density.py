"""Adaptive density control guided by the prior: what to clone, split and remove, and doing it.

Eq. (8) and the pruning rule after it. `plan` only decides, by what `density_stats.py` gathered; `apply_plan` acts, the
one place that resizes per-Gaussian tensors. `N` Gaussians.
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import TYPE_CHECKING

import numpy as np
import torch
from torch import Tensor

from ..compute.morton import morton_order
from ..core.config import DensityConfig, ReleasedMethod
from ..core.geometry import quaternion_to_matrix
from ..model.gaussians import SH_C0, Gaussians
from .density_stats import DensityStats
from .divergence import ADVICE, Diverged

if TYPE_CHECKING:
    from .optimizer import Optimizer

MAX_GAUSSIANS = 200_000  # growth stops at this count: a guard of memory, not part of the method
CLONE_EXTENT = 0.01  # Gaussians with a scale up to this share of the scene extent are cloned, larger ones split
SPLIT_SHRINK = 1.6  # children of a split have the parent's scale divided by this
PRIOR_OPACITY = 0.0075  # tau_alpha: Gaussians of low prior are removed below this mean opacity


@dataclass(frozen=True)
class Plan:
    """What one density event does to each of `N` Gaussians; at most one of the three is True."""

    clone: Tensor  # (N,) bool: a copy is added
    split: Tensor  # (N,) bool: replaced by two smaller children
    remove: Tensor  # (N,) bool: goes
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


def plan(
    stats: DensityStats,
    scales: Tensor,
    opacities: Tensor,
    extent: float,
    cfg: DensityConfig,
    released: ReleasedMethod | None = None,
    clone_extent: float = CLONE_EXTENT,
) -> Plan:
    """Choose what to clone, split and remove: Eq. (8), the prior prune, and 3DGS's rules. Pure.

    Args:
        scales: (N, 3) canonical, mm. opacities: (N,) canonical. extent: scene extent, mm.
        clone_extent: share of the extent up to which a Gaussian is cloned, not split.
    """
    released = released or ReleasedMethod()
    largest_mm, by_prior = released.prune_max_scale_mm or math.inf, cfg.min_densify_weight < 1
    score, largest = stats.score(released.unobserved_score), scales.amax(-1)
    gradient = stats.grad2d_ndc_sum / stats.num_seen.clamp(min=1)
    faint, huge = opacities < cfg.prune_opacity, largest > largest_mm
    unlikely = (score < cfg.prior_threshold) & (stats.mean_opacity(opacities) < PRIOR_OPACITY)
    distrusted = (stats.num_valid >= cfg.min_valid) & unlikely if by_prior else torch.zeros_like(faint)
    condemned = faint | huge | distrusted
    grow = (densify_weight(score, cfg) * gradient >= cfg.grow_threshold) & ~faint
    small = largest <= clone_extent * extent
    # Pruning follows growth: children are smaller and unobserved, so only their size can condemn them.
    split = grow & ~small & (largest / SPLIT_SHRINK <= largest_mm)
    clone, remove = grow & small & ~condemned, condemned & ~split
    if len(scales) + int(clone.sum()) + int(split.sum()) - int(remove.sum()) > MAX_GAUSSIANS:
        clone, split, remove = torch.zeros_like(clone), torch.zeros_like(split), condemned
    rules = {"opacity": faint} | ({"size": huge} if released.prune_max_scale_mm else {})
    return Plan(clone, split, remove, rules | ({"prior": distrusted} if by_prior else {}))


def scene_extent(camera_centers: Tensor) -> float:
    """Length that separates small from large Gaussians, mm: 1.1 times the radius of the camera centers (T, 3).

    As 3DGS has it: 0 for a still camera, so that nothing is cloned.
    """
    return 1.1 * float((camera_centers - camera_centers.mean(0)).norm(dim=-1).max())


def apply_plan(
    optimizer: Optimizer, plan: Plan, stats: DensityStats, rng: np.random.Generator
) -> tuple[DensityStats, Tensor]:
    """Clone, split and remove as planned, in the parameters, Adam's moments and the statistics alike.

    Rows that stay keep everything; the gradient sums of all are cleared, as after each event. New rows start with
    zero moments and unobserved. All are then put in the order of `morton_order`.

    Returns:
        The statistics of the new set, and for each new row the one that it was or comes from, (N',) int64.
    Raises:
        Diverged: a new Gaussian would not be finite; nothing was changed.
    """
    tensors = optimizer.gaussians.tensors
    children = split_children(optimizer.gaussians, plan.split, SPLIT_SHRINK, rng)
    added = {name: torch.cat([value.detach()[plan.clone], children[name]]) for name, value in tensors.items()}
    if not all(bool(value.isfinite().all()) for value in added.values()):
        raise Diverged(f"expected Gaussians of a finite size to split; got others. {ADVICE}")
    staying = (~(plan.remove | plan.split)).nonzero()[:, 0]
    rows = torch.cat([staying, len(plan.split) + torch.arange(len(added["means"]), device=staying.device)])
    means = torch.cat([tensors["means"].detach(), added["means"]])[rows]
    rows = rows[torch.from_numpy(morton_order(means.cpu().numpy())).to(rows.device)]
    for name, value in tensors.items():
        tensors[name] = torch.cat([value.detach(), added[name]])[rows].requires_grad_()
        if state := optimizer.states.get(name):  # none of what no gradient trains
            state.first, state.second = (_with_zeros(m, rows) for m in (state.first, state.second))
    grown = DensityStats(*(_with_zeros(value, rows) for value in stats.tensors().values()))
    for cleared in (grown.grad2d_ndc_sum, grown.num_seen):
        cleared.zero_()
    cloned, halved = (part.nonzero()[:, 0] for part in (plan.clone, plan.split))
    parents = torch.cat([torch.arange(len(plan.split), device=rows.device), cloned, halved, halved])
    return grown, parents[rows]


def reset_opacities(optimizer: Optimizer, most: float) -> None:
    """Lower every opacity above `most` to it, and let Adam forget what it knew of them."""
    logits, state = optimizer.gaussians["opacity_logits"], optimizer.states["opacity_logits"]
    logits.detach().clamp_(max=math.log(most / (1 - most)))
    state.first.zero_()
    state.second.zero_()


def split_children(gaussians: Gaussians, split: Tensor, shrink: float, rng: np.random.Generator) -> dict[str, Tensor]:
    """Two children for each Gaussian marked in `split` (N,): centers sampled from it, scales divided by `shrink`."""
    tensors = {name: value.detach()[split] for name, value in gaussians.tensors.items()}
    children = {name: torch.cat([value, value]) for name, value in tensors.items()}
    scales, quats = children["log_scales"].exp().cpu().numpy(), children["quats"].cpu().numpy()
    local = rng.normal(size=scales.shape)
    offsets = local * scales
    turned = np.einsum("nij,nj->ni", quaternion_to_matrix(quats.astype(np.float64)), offsets)
    children["means"] = children["means"] + torch.from_numpy(turned.astype(np.float32)).to(children["means"].device)
    children["log_scales"] = children["log_scales"] - math.log(shrink)
    slopes = children.get("color_slopes")
    if slopes is not None:  # each child has the color of the place where it lies
        places = torch.from_numpy(local[:, :2].astype(np.float32)).to(slopes.device)
        children["sh_dc"] = children["sh_dc"] + torch.einsum("ni,nic->nc", places, slopes)[:, None] / SH_C0
        children["color_slopes"] = slopes / shrink
    return children


def _with_zeros(values: Tensor, rows: Tensor) -> Tensor:
    """The `rows` of `values`; those beyond its end are zeros."""
    chosen = values[rows.clamp(max=len(values) - 1)]
    chosen[rows >= len(values)] = 0
    return chosen
