"""The temporal term, Eqs. (10) and (11), in PyTorch, on any device. `P` points, `K` neighbors of each.

"now" is frame t, "before" the adjacent training frame t - dt.
"""

from __future__ import annotations

import torch
from torch import Tensor

from ..core.config import TemporalConfig

SQRT_EPS = 1e-8
"""Under the root of the displacement norm, mm**2: a finite gradient at zero."""
SUM_EPS = 1e-8
"""Least pair weight, and least sum of them; a larger one would silence the term: typical weights are near 0.002."""
POINTS_AT_A_TIME = 4096
"""Points whose distances to all others are held at once."""


def local_consistency(now: Tensor, before: Tensor, weights: Tensor, cfg: TemporalConfig) -> tuple[Tensor, Tensor]:
    """L_local, Eq. (11), unweighted: neighbors are found and weighed at t - dt, then compared.

    Args:
        now, before: (P, 3) deformed centers at t and t - dt, mm, P > K. Detach `before` to train one end only.
        weights: (P,) motion weights > 0, from `temporal.choose`.
    Returns:
        Mean |d_i - d_j| (mm) and mean Huber penalty of the change of |mu_i - mu_j|, both weighted by w_ij.
    """
    indices, distances = neighbors(before.detach(), cfg.num_neighbors)
    return local_motion(now, before, indices, affinity(distances, indices, weights), cfg)


def neighbors(points: Tensor, k: int) -> tuple[Tensor, Tensor]:
    """(P, k) indices of the nearest other points of each of (P, 3) points, nearest first, and (P, k) distances, mm."""
    found = []
    for start in range(0, len(points), POINTS_AT_A_TIME):
        distances = torch.cdist(
            points[start : start + POINTS_AT_A_TIME], points, compute_mode="donot_use_mm_for_euclid_dist"
        )
        distances.diagonal(start).fill_(torch.inf)
        found.append(distances.topk(k, largest=False))
    return torch.cat([f.indices for f in found]), torch.cat([f.values for f in found])


def affinity(distances: Tensor, indices: Tensor, weights: Tensor) -> Tensor:
    """(P, K) pair weights w_ij = exp(-|mu_i - mu_j|^2 / (2 sigma_loc^2)) w_i w_j, Eq. (10), floored at `SUM_EPS`.

    sigma_loc, which the paper leaves open, is the median neighbor distance of the iteration (released code).

    Args:
        distances: (P, K) mm. indices: (P, K) of the neighbors. weights: (P,) motion weights.
    """
    sigma = distances.flatten().quantile(0.5).clamp(min=1e-8)  # as in NumPy, between the middle two of an even number
    return ((-(distances**2) / (2 * sigma**2)).exp() * weights[:, None] * weights[indices]).clamp(min=SUM_EPS)


def local_motion(
    now: Tensor, before: Tensor, indices: Tensor, pair_weights: Tensor, cfg: TemporalConfig
) -> tuple[Tensor, Tensor]:
    """The two weighted means of Eq. (11), displacement and distance, of given (P, K) neighbors and pair weights."""
    weight = pair_weights.to(now.dtype)
    weight = weight / weight.sum().clamp(min=SUM_EPS)
    displacement = now - before
    difference = displacement[:, None] - displacement[indices]
    apart = (difference.square().sum(-1) + SQRT_EPS).sqrt()
    stretch = (_length(now[:, None] - now[indices]) - _length(before[:, None] - before[indices])).abs()
    return (weight * apart).sum(), (weight * huber(stretch, cfg.huber_delta, cfg.huber_scale)).sum()


def huber(x: Tensor, delta: float, scale: str) -> Tensor:
    """Huber's penalty of x >= 0: x^2 / 2 up to delta, delta (x - delta / 2) above; `released` divides it by delta."""
    literal = torch.where(x <= delta, 0.5 * x * x, delta * (x - 0.5 * delta))
    return literal / delta if scale == "released" else literal


def _length(vectors: Tensor) -> Tensor:
    return (vectors.square().sum(-1) + SQRT_EPS**2).sqrt()
