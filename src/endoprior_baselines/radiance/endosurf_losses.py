"""EndoSurf's loss: color and depth of the ray, distance and slope at the measured surface, and two of smoothness."""

from __future__ import annotations

import torch
from torch import Tensor

COLOR, DEPTH, SURFACE, ANGLE, EIKONAL, NEIGHBOR = 1.0, 1.0, 1.0, 0.1, 0.1, 0.1
"""Weights of the terms."""
EIKONAL_WITHIN = 1.2
"""Samples within this radius count for the length of the gradient."""


def color_term(color: Tensor, target: Tensor) -> Tensor:
    """Mean over rays of the sum over channels of absolute errors (N, 3)."""
    return COLOR * (color - target).abs().sum() / len(color)


def depth_term(depth: Tensor, target: Tensor, counted: Tensor) -> Tensor:
    """Mean absolute error of depth (N,) over the rays that count."""
    return DEPTH * _mean((depth - target).abs(), counted)


def surface_terms(distance: Tensor, slope: Tensor, counted: Tensor) -> dict[str, Tensor]:
    """At the measured surface the distance is 0, and it falls along the ray.

    Args:
        distance: (N,) signed distance at the measured points.
        slope: (N,) its change along the ray. The release sums it over all rays; those without depth have no point.
    """
    return {
        "surface": SURFACE * _mean(distance.abs(), counted),
        "angle": ANGLE * _mean(torch.relu(slope), counted),
    }


def eikonal_term(gradients: Tensor, radii: Tensor) -> Tensor:
    """A distance changes by 1 per unit: mean of (|gradient| - 1)^2 over samples near the scene.

    Args:
        gradients: (P, 3). radii: (P,) distances of the samples from the center.
    """
    return EIKONAL * _mean((gradients.norm(dim=-1) - 1).square(), radii < EIKONAL_WITHIN)


def neighbor_term(gradients: Tensor, others: Tensor) -> Tensor:
    """Mean distance between unit normals (P, 3) of surface points and of points beside them; 0 without any."""
    if not len(gradients):
        return gradients.sum()
    first, second = (torch.nn.functional.normalize(each, dim=-1) for each in (gradients, others))
    return NEIGHBOR * (first - second + 1e-12).norm(dim=-1).mean()


def _mean(values: Tensor, counted: Tensor) -> Tensor:
    """Mean over those that count; 0 without any. What does not count may be anything, also not finite."""
    return torch.where(counted, values, torch.zeros_like(values)).sum() / counted.sum().clamp(min=1)
