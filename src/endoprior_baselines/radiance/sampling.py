"""Where a ray is sampled, in ascending order, and what it shows: NeRF's alpha, NeuS's alpha, and the sum.

Random numbers are passed in, never made here.
"""

from __future__ import annotations

from dataclasses import dataclass

import torch
from torch import Tensor

LAST = 1e10
"""Length of the interval behind the last sample: whatever is dense there is opaque."""
FLOOR = 1e-5
"""Added to every weight, so that a ray without weights is sampled evenly."""


def jittered(values: Tensor, shares: Tensor | None) -> Tensor:
    """Ascending samples (N, S) moved by `shares` (N, S) in [0, 1) of half the gaps to their neighbors; None: not."""
    if shares is None:
        return values
    middles = (values[:, 1:] + values[:, :-1]) / 2
    low = torch.cat([values[:, :1], middles], -1)
    high = torch.cat([middles, values[:, -1:]], -1)
    return low + (high - low) * shares


def even(near: Tensor, far: Tensor, num: int) -> Tensor:
    """(N, num) samples from near (N,) to far (N,), both included."""
    steps = torch.linspace(0, 1, num, device=near.device)
    return near[:, None] * (1 - steps) + far[:, None] * steps


def by_weight(edges: Tensor, weights: Tensor, places: Tensor) -> Tensor:
    """(N, K) samples distributed like the weights (N, S) of intervals with ascending ends `edges` (N, S + 1).

    The cumulative distribution is inverted at `places` (N, K) in [0, 1]; samples ascend where these do.
    """
    shares = weights + FLOOR
    shares = shares / shares.sum(-1, keepdim=True)
    until = torch.cat([torch.zeros_like(shares[:, :1]), shares.cumsum(-1)], -1)
    right = torch.searchsorted(until, places.contiguous(), right=True).clamp(1, weights.shape[-1])
    low, high = until.gather(-1, right - 1), until.gather(-1, right)
    start, stop = edges.gather(-1, right - 1), edges.gather(-1, right)
    within = ((places - low) / (high - low).clamp(min=1e-12)).clamp(0, 1)
    return start + within * (stop - start)


def centers(num: int, rays: int, device: torch.device) -> Tensor:
    """(rays, num) evenly spaced places in (0, 1), for `by_weight` without chance."""
    return ((torch.arange(num, device=device) + 0.5) / num).expand(rays, num)


def sphere_ends(origins: Tensor, units: Tensor) -> tuple[Tensor, Tensor]:
    """Distances (N,) along rays of unit directions at which they enter and leave the unit sphere.

    A ray that misses the sphere gets its nearest point twice; a ray from within starts at 0.
    """
    middle = -(origins * units).sum(-1)
    nearest = origins + middle[:, None] * units
    half = (1 - nearest.square().sum(-1)).clamp(min=0).sqrt()
    return (middle - half).clamp(min=0), (middle + half).clamp(min=0)


def surface_places(s: Tensor, distance: Tensor, inside: Tensor, sharpness: float) -> Tensor:
    """Weights (N, S - 1) of the intervals between samples by what NeuS would render at this sharpness.

    The slope of the distance in an interval is the smaller of its own and that of the interval before: it stays
    right where the surface turns away within one interval.

    Args:
        s: (N, S) ascending distances along the ray. distance: signed distance there. inside: lies in the unit sphere.
    """
    step = s[:, 1:] - s[:, :-1]
    slope = (distance[:, 1:] - distance[:, :-1]) / (step + 1e-5)
    before = torch.cat([torch.zeros_like(slope[:, :1]), slope[:, :-1]], -1)
    slope = torch.minimum(slope, before).clamp(-1e3, 0) * (inside[:, 1:] | inside[:, :-1])
    middle = (distance[:, 1:] + distance[:, :-1]) / 2
    enter = torch.sigmoid((middle - slope * step / 2) * sharpness)
    leave = torch.sigmoid((middle + slope * step / 2) * sharpness)
    return weights_of((enter - leave + 1e-5) / (enter + 1e-5))


def weights_of(alpha: Tensor) -> Tensor:
    """(N, S) share of each sample in its ray: its alpha times what the samples before it let through."""
    through = torch.cumprod(1 - alpha + 1e-7, -1)
    return alpha * torch.cat([torch.ones_like(through[:, :1]), through[:, :-1]], -1)


@dataclass(frozen=True)
class Composited:
    """What `N` rays show."""

    color: Tensor
    """(N, 3)."""
    depth: Tensor
    """(N,) sum of weight times depth, in the depth's unit; not divided by alpha."""
    alpha: Tensor
    """(N,) sum of weights."""
    weights: Tensor
    """(N, S)."""


def composited(alpha: Tensor, color: Tensor, depth: Tensor) -> Composited:
    """Blend samples of alpha (N, S) in [0, 1], color (N, S, 3) and depth (N, S) front to back over black."""
    weights = weights_of(alpha)
    return Composited((weights[..., None] * color).sum(1), (weights * depth).sum(1), weights.sum(1), weights)


def density_alpha(density: Tensor, depth: Tensor) -> Tensor:
    """1 - exp(-density x interval): NeRF's alpha, of density (N, S) before the ReLU at ascending depth (N, S)."""
    last = torch.full_like(depth[:, :1], LAST)
    return 1 - torch.exp(-torch.relu(density) * torch.cat([depth[:, 1:] - depth[:, :-1], last], -1))


def surface_alpha(distance: Tensor, slope: Tensor, step: Tensor, sharpness: Tensor, anneal: float) -> Tensor:
    """NeuS's alpha: how much of the logistic distribution around the surface a step takes in.

    With the slope c of the distance along the ray, the distance is d - c step / 2 where the step begins and d + c step
    / 2 where it ends; alpha = (S(begin) - S(end)) / S(begin), with S the sigmoid of sharpness times distance. At first
    a surface that faces away counts half, so that gradients reach it: `anneal` goes from 0 to 1.

    Args:
        distance: (N, S) in the middle of each `step`. slope: its change along the ray, -1 where that meets it head on.
    """
    facing = -(torch.relu(0.5 - 0.5 * slope) * (1 - anneal) + torch.relu(-slope) * anneal)
    enter = torch.sigmoid((distance - facing * step / 2) * sharpness)
    leave = torch.sigmoid((distance + facing * step / 2) * sharpness)
    return ((enter - leave + 1e-5) / (enter + 1e-5)).clamp(0, 1)
