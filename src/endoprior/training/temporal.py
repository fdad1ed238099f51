"""Texture-aware temporal consistency: neighbors move together, the more so the better their texture. Eqs. (9)-(11).

Shared letters: `N` Gaussians of the scene, `P` of them chosen for one step, `K` neighbors. "now" is frame t,
"before" the adjacent training frame t - dt.
"""

from __future__ import annotations

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from ..compute.compiled import compiled
from ..compute.neighbors import MAX_COORDINATE, nearest
from ..core.checks import check_shape
from ..core.config import TemporalConfig
from .temporal_kernels import SQRT_EPS, SUM_EPS, local_motion, median, weigh_pairs

NEIGHBOR_CHUNK = 4096
"""Points whose distances to all others are held at a time, where no kernel searches."""
MIN_WEIGHT = 1e-4
"""Motion weights up to this are treated as zero (released code)."""

SAMPLE_STEPS = 2**30
"""Into which a weight of 1 is divided to add it up off the CPU."""
RELAX_TRIES, RELAX_THRESHOLD_STEP, RELAX_TEMPERATURE_FACTOR = 8, 0.05, 1.5
RELAX_THRESHOLD_FLOOR, RELAX_TEMPERATURE_CAP = 0.25, 0.30


def motion_weight(score: NDArray, threshold: float, temperature: float) -> NDArray:
    """w^mot = sigmoid((s - tau_m) / gamma_m), Eq. (9).

    Args:
        score: (N,) texture-prior scores in [0, 1].
    Returns:
        (N,) in (0, 1).
    """
    with np.errstate(over="ignore"):  # 1 / infinity is the right weight of a score far below the threshold
        return 1 / (1 + np.exp(-(score - threshold) / temperature))


def effective_size(weights: NDArray) -> float:
    """Kish's effective sample size (sum w)^2 / sum w^2; 0 for no weight."""
    square = float((weights**2).sum())
    return float(weights.sum()) ** 2 / square if square > 0 else 0.0


def relaxed_motion_weight(score: NDArray, cfg: TemporalConfig) -> NDArray:
    """Eq. (9), with tau_m lowered and gamma_m raised until enough Gaussians count (released code).

    Returns:
        (N,) weights; those up to `MIN_WEIGHT` are 0.
    """
    threshold, temperature = cfg.motion_threshold, cfg.motion_temperature
    tries = RELAX_TRIES if cfg.adaptive_motion_weight else 0
    weights = motion_weight(score, threshold, temperature)
    for _ in range(tries):
        if effective_size(weights) >= cfg.min_effective:
            break
        threshold = max(threshold - RELAX_THRESHOLD_STEP, RELAX_THRESHOLD_FLOOR)
        temperature = min(temperature * RELAX_TEMPERATURE_FACTOR, RELAX_TEMPERATURE_CAP)
        weights = motion_weight(score, threshold, temperature)
    return np.where(weights > MIN_WEIGHT, weights, 0)


def systematic_sample(weights: NDArray, count: int) -> NDArray[np.intp]:
    """At most `count` distinct indices, spread evenly over the cumulative weight: no randomness, more where heavier.

    Args:
        weights: (N,) >= 0. count: > 0; if no more than this many weights are positive, all of them are taken.
    Returns:
        (P,) increasing indices, P <= count.
    """
    positive = np.flatnonzero(weights > 0)
    if len(positive) <= count:
        return positive
    cumulative = np.cumsum(weights[positive], dtype=np.float64)
    marks = (np.arange(count) + 0.5) / count * cumulative[-1]
    return positive[np.unique(np.searchsorted(cumulative, marks))]


def choose(score: NDArray, eligible: NDArray, cfg: TemporalConfig) -> tuple[NDArray[np.intp], NDArray]:
    """The Gaussians that take part in one step, and their motion weights.

    Args:
        score: (N,) in [0, 1]. eligible: (N,) bool, the set S_t.
    Returns:
        (P,) indices and (P,) weights; P = 0 when fewer than `min_points` qualify.
    """
    weights = relaxed_motion_weight(score, cfg) if cfg.pair_weights else np.ones_like(score)
    weights = np.where(eligible, weights, 0)
    count = cfg.max_points or len(weights)
    chosen = systematic_sample(weights, count)
    if len(chosen) < least_points(cfg):
        chosen = chosen[:0]
    return chosen, weights[chosen]


def least_points(cfg: TemporalConfig) -> int:
    """With fewer Gaussians a step goes without the term."""
    return max(cfg.min_points, cfg.num_neighbors + 1)


def choose_on(score: Tensor, eligible: Tensor, cfg: TemporalConfig) -> tuple[Tensor, Tensor]:
    """`choose`, of tensors and where they lie.

    On a device the result has the length min(max_points, N) whatever was found, so that the host need not know it; who
    takes no part has weight 0.

    Args:
        score: (N,) in [0, 1]. eligible: (N,) bool.
    Returns:
        (P,) int64 indices and (P,) float32 weights; P may be too small for the term.
    """
    if compiled(score):
        chosen, weights = choose(score.numpy(), eligible.numpy(), cfg)
        return torch.from_numpy(chosen), torch.from_numpy(weights)
    weights = relaxed_definition(score, cfg) if cfg.pair_weights else torch.ones_like(score)
    weights = torch.where(eligible, weights, 0)
    count = cfg.max_points
    if not 0 < count < len(weights):
        return torch.arange(len(weights), device=score.device), weights
    index, taken = systematic_definition(weights, count)
    return index, torch.where(taken, weights[index], 0)


def relaxed_definition(score: Tensor, cfg: TemporalConfig) -> Tensor:
    """`relaxed_motion_weight` in plain torch, on any device: all tries are made, and the first that does is kept."""
    threshold, temperature = cfg.motion_threshold, cfg.motion_temperature
    weights = ((score - threshold) / temperature).sigmoid()
    for _ in range(RELAX_TRIES if cfg.adaptive_motion_weight else 0):
        square = weights.square().sum()
        size = torch.where(square > 0, weights.sum().square() / square, 0)
        threshold = max(threshold - RELAX_THRESHOLD_STEP, RELAX_THRESHOLD_FLOOR)
        temperature = min(temperature * RELAX_TEMPERATURE_FACTOR, RELAX_TEMPERATURE_CAP)
        weights = torch.where(size >= cfg.min_effective, weights, ((score - threshold) / temperature).sigmoid())
    return torch.where(weights > MIN_WEIGHT, weights, 0)


def systematic_definition(weights: Tensor, count: int) -> tuple[Tensor, Tensor]:
    """`systematic_sample` in plain torch, on any device: always `count` < N indices, and which of them are taken."""
    positive = weights > 0
    # Whole numbers: on a GPU sums of others depend on who comes first, and with them who is chosen.
    cumulative = (weights.double() * SAMPLE_STEPS).round().to(torch.int64).cumsum(0).double()
    marks = (torch.arange(count, device=weights.device) + 0.5) / count * cumulative[-1]
    index = torch.searchsorted(cumulative, marks).clamp(max=len(weights) - 1)
    first = torch.ones_like(index[:1], dtype=torch.bool)
    several = torch.cat([first, index[1:] != index[:-1]]) & positive[index]
    few = (~positive).to(torch.uint8).argsort(stable=True)[:count]  # the positive ones first
    all_fit = positive.sum() <= count
    index = torch.where(all_fit, few, index)
    return index, torch.where(all_fit, positive[few], several)


def neighbors(points: NDArray, k: int) -> tuple[NDArray[np.intp], NDArray]:
    """The `k` nearest other points of each point; of equally near ones those with the smallest indices.

    Args:
        points: (P, 3) mm, finite, 0 < k < P.
    Returns:
        (P, k) indices, nearest first, and (P, k) distances, mm.
    Raises:
        ValueError: too few points, or a coordinate that is not finite or too large to be squared.
    """
    check_shape("points:P,3", points=points)
    if not 0 < k < len(points):
        raise ValueError(f"k must be in [1, {len(points) - 1}], the number of other points; got {k}")
    if not float(np.abs(points).max()) <= MAX_COORDINATE:
        raise ValueError(f"points must be finite, of magnitude up to {MAX_COORDINATE:g} mm")
    return nearest(np.ascontiguousarray(points), k)


def neighbors_definition(points: Tensor, k: int, taking_part: Tensor | None = None) -> tuple[Tensor, Tensor]:
    """`neighbors` in plain torch, on any device: all distances, some points at a time. Ties may fall otherwise.

    Args:
        taking_part: (P,) bool; the others are nobody's neighbors, unless fewer than k + 1 take part: then infinitely
            far ones.
    """
    found = []
    for start in range(0, len(points), NEIGHBOR_CHUNK):
        distances = torch.cdist(
            points[start : start + NEIGHBOR_CHUNK], points, compute_mode="donot_use_mm_for_euclid_dist"
        )
        distances.diagonal(start).fill_(torch.inf)
        if taking_part is not None:
            distances.masked_fill_(~taking_part, torch.inf)
        found.append(distances.topk(k, largest=False))
    return torch.cat([f.indices for f in found]), torch.cat([f.values for f in found])


def affinity_definition(distances: Tensor, indices: Tensor, weights: Tensor) -> Tensor:
    """`affinity` in plain torch, on any device; (P, K) pair weights. Who has no weight is in no pair."""
    pairs = (weights[:, None] > 0) & (weights[indices] > 0) & distances.isfinite()
    distances = torch.where(pairs, distances, torch.nan)
    # The median of an even number of distances lies between the middle two, as NumPy has it.
    sigma = distances.flatten().nanquantile(0.5).clamp(min=1e-8)
    weighed = (-(distances**2) / (2 * sigma**2)).exp() * weights[:, None] * weights[indices]
    return torch.where(pairs, weighed.clamp(min=SUM_EPS), 0)


def affinity(distances: NDArray, indices: NDArray, weights: NDArray) -> NDArray:
    """w_ij = exp(-|mu_i - mu_j|^2 / (2 sigma_loc^2)) w_i w_j, Eq. (10), floored at 1e-8.

    sigma_loc, which the paper leaves open, is the median neighbor distance of the step (released code).

    Args:
        distances: (P, K) mm. indices: (P, K) of the neighbors. weights: (P,) motion weights.
    Returns:
        (P, K) pair weights.
    """
    sigma = max(median(distances), 1e-8)
    return weigh_pairs(distances, indices, weights, sigma)


def huber(x: Tensor, delta: float, scale: str) -> Tensor:
    """Huber's penalty of x >= 0: x^2 / 2 up to delta, delta (x - delta / 2) above; `released` divides it by delta."""
    literal = torch.where(x <= delta, 0.5 * x * x, delta * (x - 0.5 * delta))
    return literal / delta if scale == "released" else literal


def local_motion_loss(
    now: Tensor, before: Tensor, indices: NDArray, pair_weights: NDArray, cfg: TemporalConfig
) -> tuple[Tensor, Tensor]:
    """The two halves of L_local, Eq. (11), unweighted: displacement and distance.

    Args:
        now, before: (P, 3) deformed centers at t and t - dt, mm. Detach `before` to train one end only.
        indices: (P, K) neighbors, found at t - dt. pair_weights: (P, K) from `affinity`.
    Returns:
        Mean |d_i - d_j| (mm) and mean Huber penalty of the change of |mu_i - mu_j|, both weighted by w_ij.
    """
    check_shape(
        "now:P,3 before:P,3 indices:P,K pair_weights:P,K",
        now=now,
        before=before,
        indices=indices,
        pair_weights=pair_weights,
    )
    if now.dtype != before.dtype:
        raise ValueError(f"before must have the type of now, {now.dtype}; got {before.dtype}")
    if not 0 <= indices.min() <= indices.max() < len(now):
        raise ValueError(f"indices must be in [0, {len(now) - 1}]; got {indices.min()} to {indices.max()}")
    factor = 1 / cfg.huber_delta if cfg.huber_scale == "released" else 1.0
    return local_motion(now, before, indices, pair_weights, cfg.huber_delta, factor)


def local_consistency(now: Tensor, before: Tensor, weights: Tensor, cfg: TemporalConfig) -> tuple[Tensor, Tensor]:
    """L_local, Eq. (11), of chosen Gaussians: neighbors found and weighed at t - dt, then compared; on any device.

    Args:
        now, before: (P, 3) deformed centers, mm; `before` detached trains one end only.
        weights: (P,) motion weights from `choose_on`; on a device, 0 for who takes no part, and both terms are 0 unless
            enough do. On the CPU there are enough, all of positive weight.
    Returns:
        Displacement and distance term, as `local_motion_loss`.
    """
    if compiled(now):
        indices, distances = neighbors(before.detach().numpy(), cfg.num_neighbors)
        return local_motion_loss(now, before, indices, affinity(distances, indices, weights.numpy()), cfg)
    taking_part = weights > 0
    enough = taking_part.sum() >= least_points(cfg)
    index, apart = neighbors_definition(before.detach(), cfg.num_neighbors, taking_part)
    terms = local_motion_definition(now, before, index, affinity_definition(apart, index, weights), cfg)
    return enough * terms[0], enough * terms[1]


def local_motion_definition(
    now: Tensor, before: Tensor, indices: NDArray, pair_weights: NDArray, cfg: TemporalConfig
) -> tuple[Tensor, Tensor]:
    """`local_motion_loss` in plain torch: same arguments, same result but for rounding, more passes."""
    index = torch.as_tensor(indices, device=now.device)
    weight = torch.as_tensor(pair_weights, device=now.device).to(now.dtype)
    weight = weight / weight.sum().clamp(min=SUM_EPS)
    displacement = now - before
    difference = displacement[:, None] - displacement[index]
    disp = (difference.square().sum(-1) + SQRT_EPS).sqrt()
    stretch = (_length(now[:, None] - now[index]) - _length(before[:, None] - before[index])).abs()
    return (weight * disp).sum(), (weight * huber(stretch, cfg.huber_delta, cfg.huber_scale)).sum()


def _length(vectors: Tensor) -> Tensor:
    return (vectors.square().sum(-1) + SQRT_EPS**2).sqrt()
