"""Texture-aware temporal consistency: neighbors move together, the more so the better their texture. Eqs. (9)-(11).

Here: which Gaussians take part in an iteration, with which motion weights, and where they were before. The term itself
is computed by `temporal_numba.py` or `temporal_torch.py`. `N` Gaussians of the scene, `P` of them chosen.
"""

from __future__ import annotations

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from ..core.config import Config, TemporalConfig
from ..core.geometry import project
from ..core.types import RenderOutput
from ..model.method import motion_of
from .frames import TrainingFrame
from .gaussians_state import GaussiansState
from .ops import TrainingOps

MIN_WEIGHT = 1e-4
"""Motion weights up to this are treated as zero (released code)."""
EVALUATIONS, RELAX_THRESHOLD_STEP, RELAX_TEMPERATURE_FACTOR = 8, 0.05, 1.5
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

    Args:
        score: (N,) in [0, 1], of the candidates only: others must not count as effective.
    Returns:
        (N,) weights; those up to `MIN_WEIGHT` are 0.
    """
    threshold, temperature = cfg.motion_threshold, cfg.motion_temperature
    weights = motion_weight(score, threshold, temperature)
    for _ in range(EVALUATIONS - 1 if cfg.adaptive_motion_weight else 0):
        if effective_size(weights) >= cfg.min_effective:
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


def choose(score: NDArray, eligible: NDArray, cfg: TemporalConfig) -> tuple[NDArray[np.intp], NDArray]:
    """The Gaussians that take part in one iteration, and their motion weights.

    Args:
        score: (N,) in [0, 1]. eligible: (N,) bool, the set S_t.
    Returns:
        (P,) indices and (P,) weights; P = 0 when fewer than `least_points` qualify.
    """
    candidates = np.flatnonzero(eligible)
    score = score[candidates]
    weights = relaxed_motion_weight(score, cfg) if cfg.pair_weights else np.ones_like(score)
    chosen = systematic_sample(weights, cfg.max_points or len(weights), cfg.refill)
    if len(chosen) < least_points(cfg):
        chosen = chosen[:0]
    return candidates[chosen], weights[chosen]


def least_points(cfg: TemporalConfig) -> int:
    """Fewest Gaussians with which the term is computed."""
    return max(cfg.min_points, cfg.num_neighbors + 1)


def temporal_terms(
    state: GaussiansState,
    frame: TrainingFrame,
    before: TrainingFrame,
    means: Tensor,
    means_before: Tensor | None,
    out: RenderOutput,
    cfg: Config,
    ops: TrainingOps,
) -> dict[str, Tensor]:
    """L_local of Eq. (11), weighted, () each; nothing with few Gaussians.

    Args:
        frame, before: at t and t - dt.
        means: (N, 3) deformed centers at t, mm. means_before: those at t - dt, if they are known already.
        out: the rendered image at t.
    """
    temporal, stats = cfg.temporal, state.stats
    seen = out.radii > 0
    if temporal.valid_at_both:
        seen = ops.valid_projection(out.means2d, out.radii, frame.tissue_mask)
    eligible = seen & (stats.num_valid >= temporal.min_valid)
    score = stats.score(cfg.density.unobserved_score)
    index, weights = (
        torch.from_numpy(each).to(means.device)
        for each in choose(score.cpu().numpy(), eligible.cpu().numpy(), temporal)
    )
    if not len(index):
        return {}
    earlier = _means_before(state, before.time, index, cfg, ops) if means_before is None else means_before[index]
    if temporal.valid_at_both:
        kept = _on_tissue(earlier.detach(), before, ops)
        index, weights, earlier = index[kept], weights[kept], earlier[kept]
        if len(index) < least_points(temporal):
            return {}
    displacement, distance = ops.local_consistency(means[index], earlier, weights, temporal)
    return {
        "displacement": temporal.weight * temporal.displacement_weight * displacement,
        "distance": temporal.weight * temporal.distance_weight * distance,
    }


def _means_before(state: GaussiansState, time: float, index: Tensor, cfg: Config, ops: TrainingOps) -> Tensor:
    """(P, 3) centers of the chosen Gaussians at an earlier time, with a gradient only if that end is trained."""
    motion = motion_of(cfg)
    if cfg.temporal.gradient == "both":
        # Moving all and then choosing is cheaper than the scattered gradient of choosing first.
        moved = state.gaussians["means"] + motion.offsets(state.gaussians, state.field, time, cfg, ops.model).means
        return moved[index]
    with torch.no_grad():
        offsets = motion.offsets(state.gaussians, state.field, time, cfg, ops.model, index)
        return state.gaussians["means"][index] + offsets.means


def _on_tissue(points: Tensor, frame: TrainingFrame, ops: TrainingOps) -> Tensor:
    """(P,) bool: whether world points (P, 3) mm project in front of the camera, into the image, onto tissue."""
    pixels, z = project(points.cpu().numpy(), frame.camera)
    means2d, in_front = torch.from_numpy(pixels.astype(np.float32)), torch.from_numpy(z > 0).int()
    return ops.valid_projection(means2d.to(points.device), in_front.to(points.device), frame.tissue_mask)
