"""Neighbors move alike: fill the gaps of tracks, and average out the noise of their depth.

Tissue behind a tool moves with the tissue around. `T` frames, `N` points, positions in world axes, mm.
"""

from __future__ import annotations

from collections import defaultdict

import numpy as np
from numba import prange
from numpy.typing import NDArray
from scipy.spatial import KDTree

from ..compute.parallel_kernels import parallel_njit

MIN_KNOWN_WEIGHT_SHARE = 0.34  # neighbors carry a point as long as those that are known have this share of the weight
CARRIERS = 12  # known points that carry a lost one
COMPANIONS, COMPANION_STEP = 128, 4
"""A point moves as the mean of its 128 nearest points; every fourth of them is asked, the nearest first."""


def fill_gaps(positions: NDArray[np.floating]) -> NDArray[np.floating]:
    """Tracks (T, N, 3) without the gaps, NaN, of `positions` (T, N, 3).

    A lost point keeps its place among its neighbors: those nearest to it in the last frame in which it was known, and
    in the next one. Both predictions are weighted by how recent they are. A point whose neighbors are all lost stays
    where it was last; one that is never known stays NaN.
    """
    known = np.isfinite(positions[..., 0])
    filled, since = _swept(positions, known, 1)
    backward, until = _swept(positions, known, -1)
    for t in range(len(positions)):  # one frame after the other: many points in many frames fit in memory
        both, ahead = (since[t] > 0) & (until[t] > 0), (since[t] < 0) & (until[t] > 0)
        share = (until[t, both] / (since[t, both] + until[t, both])).astype(positions.dtype)[:, None]
        filled[t, both] = share * filled[t, both] + (1 - share) * backward[t, both]
        filled[t, ahead] = backward[t, ahead]
    for step in (1, -1):  # what is lost still stays where it was before, else where it is next
        for t in range(len(filled))[::step][:-1]:
            gap = np.isnan(filled[t + step])
            filled[t + step][gap] = filled[t][gap]
    return filled


def _swept(
    positions: NDArray[np.floating], known: NDArray[np.bool_], step: int
) -> tuple[NDArray[np.floating], NDArray[np.int16]]:
    """Positions carried in one direction of time, and the frames since they were known; -1 where they are not."""
    carried, age = positions.copy(), np.where(known, np.int16(0), np.int16(-1))
    order = range(len(positions))[::step]
    waiting: dict[int, list[NDArray[np.intp]]] = defaultdict(list)
    for t in order[:-1]:
        lost = np.concatenate([np.flatnonzero(known[t] & ~known[t + step]), *waiting.pop(t, [])])
        carriers = np.flatnonzero(known[t] & known[t + step])
        if not len(lost) or len(carriers) < CARRIERS:
            continue
        distances, nearest = KDTree(carried[t, carriers]).query(carried[t, lost], k=CARRIERS)
        ends = carry(carried, known, t, step, lost, carriers[nearest], weights_by_distance(distances), age)
        for end in np.unique(ends[ends >= 0]):
            waiting[int(end)].append(lost[ends == end])
    return carried, age


def smooth_motion(positions: NDArray[np.floating], origins: NDArray[np.integer]) -> NDArray[np.float32]:
    """(T, N, 3) displacement of each point from its source frame (N,), mm: the mean of that of the points around it.

    Measured depth errs by ten times as much as the flow does, and differently for each pixel. Points a fraction of a
    millimeter apart move alike.
    """
    offsets = np.empty(positions.shape, np.float32)
    count = min(COMPANIONS, positions.shape[1])
    for source in np.unique(origins):
        own = np.flatnonzero(origins == source)
        tree, asked = KDTree(positions[source]), np.arange(1, count + 1, COMPANION_STEP)
        distances, nearest = tree.query(positions[source, own], k=asked, workers=-1)  # pyright: ignore[reportArgumentType]
        mean_displacement(positions, source, own, nearest, weights_by_distance(distances), offsets)
    return offsets


def weights_by_distance(distances: NDArray[np.floating]) -> NDArray[np.floating]:
    """(P, k) a Gaussian of the distance (P, k) whose width is the mean of the row; of sum 1."""
    weights = np.exp(-0.5 * (distances / np.maximum(distances.mean(1, keepdims=True), 1e-6)) ** 2)
    return weights / weights.sum(1, keepdims=True)


@parallel_njit()
def carry(positions, known, start, step, points, neighbors, weights, age):
    # Carry `points` (P,), lost after frame `start`, by the mean displacement of their `neighbors` (P, k) since then.
    # positions (T, N, 3) are written, and age (T, N), the frames since a position was measured, where `known` (T, N)
    # says that it was not. `step`, +1 or -1, is the direction in time. Returns (P,) the frame from which the neighbors
    # no longer suffice, and the point needs others; -1 if they do.
    ends = np.full(len(points), -1)
    for p in prange(len(points)):
        n, t, moved = points[p], start + step, np.zeros(3)
        while 0 <= t < len(positions) and not known[t, n]:
            total = 0.0
            moved[:] = 0.0
            for k in range(neighbors.shape[1]):
                j = neighbors[p, k]
                if known[t, j]:
                    total += weights[p, k]
                    for c in range(3):
                        moved[c] += weights[p, k] * (positions[t, j, c] - positions[start, j, c])
            if total < MIN_KNOWN_WEIGHT_SHARE:
                ends[p] = t - step
                break
            for c in range(3):
                positions[t, n, c] = positions[start, n, c] + moved[c] / total
            age[t, n] = age[t - step, n] + 1
            t += step
    return ends


@parallel_njit()
def mean_displacement(positions, source, points, neighbors, weights, offsets):
    # Set offsets (T, N, 3) of `points` (P,) to the mean displacement of `neighbors` (P, k) since frame `source`.
    for p in prange(len(points)):
        moved = np.zeros(3)
        for t in range(len(positions)):
            moved[:] = 0.0
            for k in range(neighbors.shape[1]):
                j = neighbors[p, k]
                for c in range(3):
                    moved[c] += weights[p, k] * (positions[t, j, c] - positions[source, j, c])
            for c in range(3):
                offsets[t, points[p], c] = moved[c]
