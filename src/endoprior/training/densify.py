"""Carrying out a plan of density control: the one place that resizes per-Gaussian tensors."""

from __future__ import annotations

import math

import numpy as np
import torch
from torch import Tensor

from ..compute.morton import morton_order
from ..core.geometry import quaternion_to_matrix
from ..model.gaussians import SH_C0, Gaussians
from .density import DensityStats, Plan
from .divergence import ADVICE, Diverged
from .optimizer import Optimizer


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
