"""From samples along a ray to its color and depth: NeRF's alpha, NeuS's alpha, and the sum."""

from __future__ import annotations

from dataclasses import dataclass

import torch
from torch import Tensor

from .sampling import weights_of


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
    """Blend samples front to back over black.

    Args:
        alpha: (N, S) in [0, 1]. color: (N, S, 3). depth: (N, S).
    """
    weights = weights_of(alpha)
    return Composited((weights[..., None] * color).sum(1), (weights * depth).sum(1), weights.sum(1), weights)


LAST = 1e10
"""Length of the interval behind the last sample: whatever is dense there is opaque."""


def density_alpha(density: Tensor, depth: Tensor) -> Tensor:
    """1 - exp(-density x interval): NeRF's alpha.

    Args:
        density: (N, S) before the ReLU.
        depth: (N, S) ascending.
    """
    last = torch.full_like(depth[:, :1], LAST)
    return 1 - torch.exp(-torch.relu(density) * torch.cat([depth[:, 1:] - depth[:, :-1], last], -1))


def surface_alpha(distance: Tensor, slope: Tensor, step: Tensor, sharpness: Tensor, anneal: float) -> Tensor:
    """NeuS's alpha: how much of the logistic distribution around the surface a step takes in.

    With the slope c of the distance along the ray, the distance is d - c step / 2 where the step begins and d + c step
    / 2 where it ends; alpha = (S(begin) - S(end)) / S(begin), with S the sigmoid of sharpness times distance. At first
    a surface that faces away counts half, so that gradients reach it: `anneal` goes from 0 to 1.

    Args:
        distance: (N, S) in the middle of each step.
        slope: (N, S) change of the distance along the ray, -1 where it meets the surface head on.
        step: (N, S). sharpness: ().
    Returns:
        (N, S) in [0, 1].
    """
    facing = -(torch.relu(0.5 - 0.5 * slope) * (1 - anneal) + torch.relu(-slope) * anneal)
    enter = torch.sigmoid((distance - facing * step / 2) * sharpness)
    leave = torch.sigmoid((distance + facing * step / 2) * sharpness)
    return ((enter - leave + 1e-5) / (enter + 1e-5)).clamp(0, 1)
