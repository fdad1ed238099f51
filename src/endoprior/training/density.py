"""Adaptive density control guided by the prior: running statistics, what to clone, split and remove, and doing it.

Eqs. (7) and (8) and the pruning rule after them. `plan` only decides; `apply_plan` acts, the one place that resizes
per-Gaussian tensors. Statistics are gathered in PyTorch here, on any device, and by `density_numba.py`. `skip` is a ()
float32 tensor on the device, or None: where it is not 0, nothing is added (`divergence.py`). `N` Gaussians.
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import TYPE_CHECKING

import numpy as np
import torch
from torch import Tensor
from torch.nn.functional import grid_sample

from ..compute.morton import morton_order
from ..core.config import DensityConfig
from ..core.geometry import quaternion_to_matrix
from ..core.types import RenderOutput
from ..model.gaussians import SH_C0, Gaussians
from .adam import gradient_of
from .divergence import ADVICE, Diverged

if TYPE_CHECKING:
    from .optimizer import Optimizer

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


def add_gradient(stats: DensityStats, out: RenderOutput, width: int, height: int, skip: Tensor | None = None) -> None:
    """Add the screen-space gradient of one image, after backward; Gaussians that were not rendered keep their sums.

    Args:
        width, height: of the image, px.
    """
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
    children = split_children(optimizer.gaussians, plan.split, optimizer.cfg.density.split_shrink, rng)
    added = {name: torch.cat([value.detach()[plan.clone], children[name]]) for name, value in tensors.items()}
    if not all(bool(value.isfinite().all()) for value in added.values()):
        raise Diverged(f"expected Gaussians of a finite size to split; got others. {ADVICE}")
    staying = (~(plan.remove | plan.split)).nonzero()[:, 0]
    rows = torch.cat([staying, len(plan.split) + torch.arange(len(added["means"]), device=staying.device)])
    means = torch.cat([tensors["means"].detach(), added["means"]])[rows]
    rows = rows[torch.from_numpy(morton_order(means.cpu().numpy())).to(rows.device)]
    for name, value in tensors.items():
        tensors[name] = torch.cat([value.detach(), added[name]])[rows].requires_grad_()
        state = optimizer.states[name]
        state.first, state.second = (_with_zeros(m, rows) for m in (state.first, state.second))
    grown = DensityStats(*(_with_zeros(value, rows) for value in stats.tensors().values()))
    grown.clear_gradient()
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
