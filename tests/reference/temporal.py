"""The temporal term, Eqs. (9)-(11), as literal loops over Gaussians and pairs."""

from __future__ import annotations

import math

import numpy as np
from numpy.typing import NDArray

DELTA = 0.01
"""Huber's delta, mm."""


def pair_weights(points: NDArray, indices: NDArray, weights: NDArray) -> NDArray:
    """(P, K) w_ij of Eq. (10); sigma is the median neighbor distance."""
    pairs = [(i, j) for i in range(len(points)) for j in indices[i]]
    apart = np.array([np.sqrt(np.sum((points[i] - points[j]) ** 2)) for i, j in pairs])
    sigma = np.median(apart)
    found = [np.exp(-(d**2) / (2 * sigma**2)) * weights[i] * weights[j] for d, (i, j) in zip(apart, pairs, strict=True)]
    return np.reshape(found, indices.shape)


def local_motion(now: NDArray, before: NDArray, indices: NDArray, pair: NDArray) -> tuple[float, float]:
    """Displacement and distance of Eq. (11)."""
    displacement = distance = total = 0.0
    for i in range(len(now)):
        for k, j in enumerate(indices[i]):
            moved_i, moved_j = now[i] - before[i], now[j] - before[j]
            change = abs(np.linalg.norm(now[i] - now[j]) - np.linalg.norm(before[i] - before[j]))
            penalty = change**2 / 2 if change <= DELTA else DELTA * (change - DELTA / 2)
            displacement += pair[i, k] * np.linalg.norm(moved_i - moved_j)
            distance += pair[i, k] * penalty
            total += pair[i, k]
    return displacement / total, distance / total


def relaxed_weights(scores: list[float], wanted: float, threshold: float, temperature: float) -> list[float]:
    """w^mot of Eq. (9) of the candidates, relaxed as in the released code: eight evaluations, the first as given."""
    weights: list[float] = []
    for _ in range(8):
        weights = [1 / (1 + math.exp(-(s - threshold) / temperature)) for s in scores]
        if sum(weights) ** 2 >= wanted * sum(w * w for w in weights):
            break
        threshold, temperature = max(threshold - 0.05, 0.25), min(temperature * 1.5, 0.30)
    return [w if w > 1e-4 else 0.0 for w in weights]


def refilled_sample(weights: list[float], count: int) -> list[int]:
    """`count` marks, evenly spaced along the stacked weights, then the heaviest that no mark hit, first index first."""
    stacked = []
    for weight in weights:
        stacked.append((stacked[-1] if stacked else 0.0) + weight)
    chosen: list[int] = []
    for k in range(count):
        mark = (k + 0.5) / count * stacked[-1]
        hit = next(i for i, top in enumerate(stacked) if top >= mark)
        if hit not in chosen:
            chosen.append(hit)
    while len(chosen) < count:
        left = [i for i in range(len(weights)) if i not in chosen and weights[i] > 0]
        if not left:
            break
        chosen.append(max(left, key=lambda i: weights[i]))
    return sorted(chosen)
