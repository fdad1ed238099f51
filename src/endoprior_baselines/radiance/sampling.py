"""Where a ray is sampled: depths, or distances, in ascending order. Random numbers are passed in, never made here."""

from __future__ import annotations

import torch
from torch import Tensor

FLOOR = 1e-5
"""Added to every weight, so that a ray without weights is sampled evenly."""


def jittered(values: Tensor, shares: Tensor | None) -> Tensor:
    """Ascending samples moved at random within the halves of the gaps to their neighbors; None leaves them.

    Args:
        values: (N, S).
        shares: (N, S) in [0, 1).
    """
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
    """Samples distributed like the weights of intervals: the inverse of their cumulative distribution.

    Args:
        edges: (N, S + 1) ascending ends of the intervals.
        weights: (N, S) at least 0.
        places: (N, K) in [0, 1], where the distribution is inverted.
    Returns:
        (N, K), ascending where `places` are.
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
        s: (N, S) ascending distances along the ray.
        distance: (N, S) signed distance there.
        inside: (N, S) whether a sample lies in the unit sphere.
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
