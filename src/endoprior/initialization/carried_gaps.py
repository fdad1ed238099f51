"""Fill the gaps of tracks: where a point is lost, it moves as the known points around it do.

Tissue behind a tool moves with the tissue around. `T` frames, `N` points, positions in world axes, mm.
"""

from __future__ import annotations

from collections import defaultdict

import numpy as np
from numpy.typing import NDArray
from scipy.spatial import cKDTree

from . import track_kernels as kernels

CARRIERS = 12
"""Known points that carry a lost one."""


def fill_gaps(positions: NDArray[np.float64]) -> NDArray[np.float64]:
    """Tracks without gaps.

    A lost point keeps its place among its neighbors: those nearest to it in the last frame in which it was known, and
    in the next one. Both predictions are weighted by how recent they are.

    Args:
        positions: (T, N, 3), NaN where a point is lost.
    Returns:
        (T, N, 3); a point that is never known, or whose neighbors all are lost, stays where it was last, or is NaN.
    """
    known = np.isfinite(positions[..., 0])
    forward, since = _swept(positions, known, 1)
    backward, until = _swept(positions, known, -1)
    with np.errstate(divide="ignore", invalid="ignore"):
        share = np.where(since < 0, 0.0, np.where(until < 0, 1.0, until / (since + until)))[..., None]
    blended = np.where(share > 0, share * forward, 0) + np.where(share < 1, (1 - share) * backward, 0)
    return _held(np.where(known[..., None], positions, blended))


def _swept(
    positions: NDArray[np.float64], known: NDArray[np.bool_], step: int
) -> tuple[NDArray[np.float64], NDArray[np.intp]]:
    """Positions carried in one direction of time, and the frames since they were known; -1 where they are not."""
    carried, age = positions.copy(), np.where(known, 0, -1)
    order = range(len(positions))[::step]
    waiting: dict[int, list[NDArray[np.intp]]] = defaultdict(list)
    for t in order[:-1]:
        lost = np.concatenate([np.flatnonzero(known[t] & ~known[t + step]), *waiting.pop(t, [])])
        carriers = np.flatnonzero(known[t] & known[t + step])
        if not len(lost) or len(carriers) < CARRIERS:
            continue
        distances, nearest = cKDTree(carried[t, carriers]).query(carried[t, lost], k=CARRIERS)
        weights = np.exp(-0.5 * (distances / np.maximum(distances.mean(1, keepdims=True), 1e-6)) ** 2)
        weights /= weights.sum(1, keepdims=True)
        ends = kernels.carry(carried, known, t, step, lost, carriers[nearest], weights, age)
        for end in np.unique(ends[ends >= 0]):
            waiting[int(end)].append(lost[ends == end])
    return carried, age


def _held(positions: NDArray[np.float64]) -> NDArray[np.float64]:
    """Positions (T, N, 3) with NaN replaced by the point's nearest frame before, else after."""
    for step in (1, -1):
        order = range(len(positions))[::step]
        for t in order[:-1]:
            gap = np.isnan(positions[t + step])
            positions[t + step][gap] = positions[t][gap]
    return positions
