"""The temporal term, Eqs. (10) and (11), as literal loops over pairs."""

from __future__ import annotations

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
