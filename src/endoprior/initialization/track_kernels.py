"""Numba kernels of the tracks: steps along optical flow, and points that move as their neighbors do.

Shared letters: `N` points, `T` frames. Pixels are float64 with centers at half integers. Inputs are not checked.
"""

from __future__ import annotations

import numpy as np
from numba import njit, prange

LEAST_SHARE = 0.34
"""Neighbors carry a point as long as those that are known have this share of the weight."""


@njit(parallel=True, cache=True)
def follow(pixels, there, back, tissue_mask, out, cycle_px):
    """Move pixels (N, 2) along the flow `there` (h, w, 2), and measure by how much `back` misses their start.

    `cycle_px` is infinite where the point leaves the image or the tissue (H, W). Flow is in px of its own size, all
    else in px of the mask.
    """
    height, width = tissue_mask.shape
    scale_x, scale_y = width / there.shape[1], height / there.shape[0]
    for n in prange(len(pixels)):
        x, y = pixels[n]
        step_x, step_y = _flow(there, x / scale_x, y / scale_y)
        x, y = x + step_x * scale_x, y + step_y * scale_y
        out[n, 0], out[n, 1] = x, y
        cycle_px[n] = np.inf
        if 0 <= x <= width and 0 <= y <= height and tissue_mask[_cell(y, height), _cell(x, width)]:
            back_x, back_y = _flow(back, x / scale_x, y / scale_y)
            cycle_px[n] = np.hypot((step_x + back_x) * scale_x, (step_y + back_y) * scale_y)


@njit(parallel=True, cache=True)
def carry(positions, known, start, step, points, neighbors, weights, age):
    """Carry points that are lost after frame `start` by the mean displacement of neighbors since then.

    Args:
        positions: (T, N, 3), NaN where nothing is known; written in the frames in which a point is carried.
        known: (T, N) True where a position was measured.
        step: +1 or -1: the direction in time.
        points: (P,) points whose position at `start` is set. neighbors: (P, k) points known at `start`.
        weights: (P, k), of sum 1.
        age: (T, N) frames since the position was measured; written beside `positions`.
    Returns:
        (P,) frame from which the neighbors no longer suffice, and the point needs others; -1 if they do.
    """
    num_frames = len(positions)
    ends = np.full(len(points), -1)
    for p in prange(len(points)):
        n = points[p]
        t = start + step
        while 0 <= t < num_frames and not known[t, n]:
            total = x = y = z = 0.0
            for k in range(neighbors.shape[1]):
                j = neighbors[p, k]
                if known[t, j]:
                    total += weights[p, k]
                    x += weights[p, k] * (positions[t, j, 0] - positions[start, j, 0])
                    y += weights[p, k] * (positions[t, j, 1] - positions[start, j, 1])
                    z += weights[p, k] * (positions[t, j, 2] - positions[start, j, 2])
            if total < LEAST_SHARE:
                ends[p] = t - step
                break
            positions[t, n, 0] = positions[start, n, 0] + x / total
            positions[t, n, 1] = positions[start, n, 1] + y / total
            positions[t, n, 2] = positions[start, n, 2] + z / total
            age[t, n] = age[t - step, n] + 1
            t += step
    return ends


@njit(parallel=True, cache=True)
def mean_displacement(positions, source, points, neighbors, weights, offsets):
    """Set offsets (T, N, 3) of `points` (P,) to the mean displacement of `neighbors` (P, k) since frame `source`."""
    for p in prange(len(points)):
        for t in range(len(positions)):
            x = y = z = 0.0
            for k in range(neighbors.shape[1]):
                j = neighbors[p, k]
                x += weights[p, k] * (positions[t, j, 0] - positions[source, j, 0])
                y += weights[p, k] * (positions[t, j, 1] - positions[source, j, 1])
                z += weights[p, k] * (positions[t, j, 2] - positions[source, j, 2])
            offsets[t, points[p], 0], offsets[t, points[p], 1], offsets[t, points[p], 2] = x, y, z


@njit(inline="always")
def _flow(flow, x, y):
    # Bilinear, as in `geometry.bilinear`; outside of the image, the border value is repeated.
    height, width = flow.shape[:2]
    u, v = min(max(x - 0.5, 0.0), width - 1.0), min(max(y - 0.5, 0.0), height - 1.0)
    column, row = int(u), int(v)
    fx, fy = u - column, v - row
    x = y = 0.0
    for i, j, weight in (
        (row, column, (1 - fx) * (1 - fy)),
        (row, min(column + 1, width - 1), fx * (1 - fy)),
        (min(row + 1, height - 1), column, (1 - fx) * fy),
        (min(row + 1, height - 1), min(column + 1, width - 1), fx * fy),
    ):
        x, y = x + weight * flow[i, j, 0], y + weight * flow[i, j, 1]
    return x, y


@njit(inline="always")
def _cell(position, size):
    return min(int(position), size - 1)
