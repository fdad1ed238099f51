"""Where rays first meet a surface given by a signed distance."""

from __future__ import annotations

from collections.abc import Callable

import torch
from torch import Tensor

from .sampling import even, sphere_ends

STEPS, SECANT_STEPS = 128, 8


@torch.no_grad()
def first_crossing(distance: Callable[[Tensor], Tensor], origins: Tensor, units: Tensor) -> Tensor:
    """Points at which rays enter the surface, by even steps within the unit sphere and then the secant method.

    Args:
        distance: (P, 3) to (P,). origins, units: (N, 3) of the rays.
    Returns:
        (K, 3) points of the K <= N rays that do.
    """
    s = even(*sphere_ends(origins, units), STEPS)
    points = origins[:, None] + s[..., None] * units[:, None]
    values = distance(points.flatten(0, 1)).view_as(s)
    enters = (values[:, :-1] > 0) & (values[:, 1:] <= 0)
    rows = enters.any(-1).nonzero()[:, 0]
    at = enters[rows].int().argmax(-1)
    low, high = s[rows, at], s[rows, at + 1]
    above, below = values[rows, at], values[rows, at + 1]
    middle = low
    for _ in range(SECANT_STEPS):
        middle = low + (high - low) * above / (above - below).clamp(min=1e-12)
        value = distance(origins[rows] + middle[:, None] * units[rows])
        outside = value > 0
        low, above = torch.where(outside, middle, low), torch.where(outside, value, above)
        high, below = torch.where(outside, high, middle), torch.where(outside, below, value)
    return origins[rows] + middle[:, None] * units[rows]
