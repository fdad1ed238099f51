"""Texture-aware temporal consistency: neighbors move together, the more so the better their texture. Eqs. (9)-(11).

Which Gaussians take part in an iteration, with which motion weights, and where they were before; `local_motion.py` has
the term itself. `N` Gaussians of the scene, `P` of them chosen.
"""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from ..core.config import Config, TemporalConfig
from ..core.geometry import project
from ..model.motion import Motion
from .density_stats import DensityStats
from .frames import TrainingFrame
from .local_motion import NUM_NEIGHBORS

if TYPE_CHECKING:
    from .ops import TrainingOps
    from .state import Before, ForwardPass

DISPLACEMENT_WEIGHT, DISTANCE_WEIGHT = 1.0, 0.2  # lambda_disp and lambda_dist
MOTION_THRESHOLD, MOTION_TEMPERATURE = 0.45, 0.08  # tau_m and gamma_m of Eq. (9)
MAX_SAMPLED_GAUSSIANS = 1024  # Gaussians that are sampled by weight for an iteration that trains one time
MIN_EFFECTIVE = 256  # effective sample size that the released code relaxes the weights for
MIN_WEIGHT = 1e-4  # motion weights up to this are treated as zero (released code)
EVALUATIONS, RELAX_THRESHOLD_STEP, RELAX_TEMPERATURE_FACTOR = 8, 0.05, 1.5
RELAX_THRESHOLD_FLOOR, RELAX_TEMPERATURE_CAP = 0.25, 0.30


def motion_weight(score: NDArray, threshold: float, temperature: float) -> NDArray:
    """(N,) w^mot = sigmoid((s - tau_m) / gamma_m) of texture-prior scores s (N,), Eq. (9)."""
    with np.errstate(over="ignore"):  # 1 / infinity is the right weight of a score far below the threshold
        return 1 / (1 + np.exp(-(score - threshold) / temperature))


def effective_size(weights: NDArray) -> float:
    """Kish's effective sample size (sum w)^2 / sum w^2; 0 for no weight."""
    square = float((weights**2).sum())
    return float(weights.sum()) ** 2 / square if square > 0 else 0.0


def kept_motion_weight(score: NDArray, relaxed: bool = False) -> NDArray:
    """(N,) weights of Eq. (9) by `score` (N,) of candidates; those up to `MIN_WEIGHT` are 0.

    `relaxed` lowers tau_m and raises gamma_m until enough Gaussians count (released code).
    """
    threshold, temperature = MOTION_THRESHOLD, MOTION_TEMPERATURE
    weights = motion_weight(score, threshold, temperature)
    for _ in range(EVALUATIONS - 1 if relaxed else 0):
        if effective_size(weights) >= MIN_EFFECTIVE:
            break
        threshold = max(threshold - RELAX_THRESHOLD_STEP, RELAX_THRESHOLD_FLOOR)
        temperature = min(temperature * RELAX_TEMPERATURE_FACTOR, RELAX_TEMPERATURE_CAP)
        weights = motion_weight(score, threshold, temperature)
    return np.where(weights > MIN_WEIGHT, weights, 0)


def systematic_sample(weights: NDArray, count: int, refill: bool = False) -> NDArray[np.intp]:
    """At most `count` distinct indices, spread evenly over the cumulative weight: no randomness, more where heavier.

    Args:
        weights: (N,) >= 0. count: > 0; if no more than this many weights are positive, all of them are taken.
        refill: several marks can fall on a heavy index; take the heaviest of the others until there are `count`.
    Returns:
        (P,) increasing indices, P <= count.
    """
    positive = np.flatnonzero(weights > 0)
    if len(positive) <= count:
        return positive
    cumulative = np.cumsum(weights[positive], dtype=np.float64)
    marks = (np.arange(count) + 0.5) / count * cumulative[-1]
    hit = np.unique(np.searchsorted(cumulative, marks))
    if refill and len(hit) < count:
        others = np.setdiff1d(np.arange(len(positive)), hit, assume_unique=True)
        heaviest = others[np.argsort(-weights[positive[others]], kind="stable")][: count - len(hit)]
        hit = np.sort(np.concatenate([hit, heaviest]))
    return positive[hit]


def choose(
    score: NDArray, eligible: NDArray, cfg: TemporalConfig, released: bool = False
) -> tuple[NDArray[np.intp], NDArray]:
    """The Gaussians that take part in one iteration (P,), and their motion weights; none if too few qualify.

    Args:
        score: (N,) in [0, 1]. eligible: (N,) bool, the set S_t.
    """
    candidates = np.flatnonzero(eligible)
    score = score[candidates]
    weights = np.ones_like(score) if cfg.without == "pair_weights" else kept_motion_weight(score, released)
    chosen = systematic_sample(weights, len(weights) if cfg.gradient == "both" else MAX_SAMPLED_GAUSSIANS, released)
    if len(chosen) < least_points(cfg):
        chosen = chosen[:0]
    return candidates[chosen], weights[chosen]


def least_points(cfg: TemporalConfig) -> int:
    """Fewest Gaussians with which the term is computed."""
    return max(cfg.min_points, NUM_NEIGHBORS + 1)


def temporal_terms(
    forward: ForwardPass, before: Before, motion: Motion, stats: DensityStats, cfg: Config, ops: TrainingOps
) -> dict[str, Tensor]:
    """L_local of Eq. (11), weighted, () each; nothing with few Gaussians."""
    temporal, out, means = cfg.temporal, forward.out, forward.splats.means
    seen = out.radii > 0
    both = temporal.gradient == "both"
    if both:
        seen = ops.valid_projection(out.means2d, out.radii, before.tissue_mask_now)
    eligible = seen & (stats.num_valid >= temporal.min_valid)
    score = stats.score(cfg.released.unobserved_score)
    index, weights = (
        torch.from_numpy(each).to(means.device)
        for each in choose(score.cpu().numpy(), eligible.cpu().numpy(), temporal, cfg.released.prior)
    )
    if not len(index):
        return {}
    earlier = _means_before(forward, before, motion, index, cfg, ops)
    if both:
        kept = _on_tissue(earlier.detach(), before.frame, ops)
        index, weights, earlier = index[kept], weights[kept], earlier[kept]
        if len(index) < least_points(temporal):
            return {}
    displacement, distance = ops.local_consistency(means[index], earlier, weights, cfg.released.prior)
    return {
        "displacement": temporal.weight * DISPLACEMENT_WEIGHT * displacement,
        "distance": temporal.weight * (0.0 if temporal.without == "distance" else DISTANCE_WEIGHT) * distance,
    }


def _means_before(
    forward: ForwardPass, before: Before, motion: Motion, index: Tensor, cfg: Config, ops: TrainingOps
) -> Tensor:
    """(P, 3) centers of the chosen Gaussians at the frame before, with a gradient only if that end is trained."""
    if before.means is not None:
        return before.means[index]
    means, known = forward.gaussians["means"], (forward.gaussians, forward.field, before.frame.time, cfg, ops.model)
    if cfg.temporal.gradient == "both":
        # Moving all and then choosing is cheaper than the scattered gradient of choosing first.
        return (means + motion.offsets(*known).means)[index]
    with torch.no_grad():
        return means[index] + motion.offsets(*known, index).means


def _on_tissue(points: Tensor, frame: TrainingFrame, ops: TrainingOps) -> Tensor:
    """(P,) bool: whether world points (P, 3) mm project in front of the camera, into the image, onto tissue."""
    pixels, z = project(points.cpu().numpy(), frame.camera)
    means2d, in_front = torch.from_numpy(pixels.astype(np.float32)), torch.from_numpy(z > 0).int()
    return ops.valid_projection(means2d.to(points.device), in_front.to(points.device), frame.tissue_mask)
