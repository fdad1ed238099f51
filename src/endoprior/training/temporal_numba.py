"""The temporal term, Eqs. (10) and (11), in Numba: few passes, value and gradient together. CPU.

Computes what `temporal.py` computes. Shared letters: `P` points, `K` neighbors.

A pair (i, j) pulls on both of its points. Each point therefore visits its own neighbors and then those whose neighbor
it is, in order of their index, so no task writes another's row. Sums are taken per run of points, then over runs in
order: they are bit-identical whatever the number of threads.
"""

from __future__ import annotations

from typing import Any

import numpy as np
import torch
from numba import njit, prange
from numpy.typing import NDArray
from torch import Tensor
from torch.autograd.function import once_differentiable

from ..compute.fastmath import REORDERED
from ..compute.neighbors import MAX_COORDINATE, nearest
from ..core.checks import check_shape
from .temporal import HUBER_DELTA, NUM_NEIGHBORS, SQRT_EPS, SUM_EPS

_POINTS_PER_TASK = 256


def local_consistency(now: Tensor, before: Tensor, weights: Tensor, smooth_l1: bool = False) -> tuple[Tensor, Tensor]:
    """See `temporal.local_consistency`."""
    indices, distances = neighbors(before.detach().numpy(), NUM_NEIGHBORS)
    return local_motion(now, before, indices, affinity(distances, indices, weights.numpy()), smooth_l1)


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


def affinity(distances: NDArray[np.float64], indices: NDArray[np.intp], weights: NDArray) -> NDArray[np.float64]:
    """(P, K) pair weights: see `temporal.affinity`."""
    sigma = max(float(np.median(distances)), 1e-8)
    out = np.empty(distances.shape)
    _weigh_pairs(distances, indices, weights, 1 / (2 * sigma**2), out)
    return out


def local_motion(
    now: Tensor, before: Tensor, indices: NDArray[np.intp], pair_weights: NDArray, smooth_l1: bool = False
) -> tuple[Tensor, Tensor]:
    """See `temporal.local_motion`; the gradient flows to `now` and `before`.

    Raises:
        ValueError: shapes or types disagree, or an index is out of range.
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
    factor = 1 / HUBER_DELTA if smooth_l1 else 1.0
    return _LocalMotion.apply(now, before, indices, pair_weights, HUBER_DELTA, factor)


class _LocalMotion(torch.autograd.Function):
    @staticmethod
    def forward(ctx: Any, now, before, indices, weights, delta, factor) -> tuple[Tensor, Tensor]:
        a, b = (t.detach().contiguous().numpy() for t in (now, before))
        num = len(a)
        weights = np.ascontiguousarray(weights, dtype=a.dtype)
        starts, sources, incoming = np.zeros(num + 1, np.int64), np.empty(0, np.int32), np.empty(0, a.dtype)
        if any(ctx.needs_input_grad):
            sources, incoming = np.empty(indices.size, np.int32), np.empty(indices.size, a.dtype)
            _list_incoming(indices, weights, starts, sources, incoming)
        grads = np.empty((3, num, 3), a.dtype)
        sums = np.empty((-(-num // _POINTS_PER_TASK), 3))
        constants = np.array([0.5, delta, factor, SQRT_EPS, 0.0], a.dtype)
        _pull(a, b, indices, weights, starts, sources, incoming, constants, grads, sums)
        total, displacement, distance = sums.sum(0)
        ctx.total = max(float(total), SUM_EPS)
        ctx.grads = torch.from_numpy(grads)
        return now.new_tensor(displacement / ctx.total), now.new_tensor(distance / ctx.total)

    @staticmethod
    @once_differentiable
    def backward(ctx: Any, v_displacement: Tensor, v_distance: Tensor) -> tuple:
        pull, stretch_now, stretch_before = ctx.grads
        v_displacement, v_distance = v_displacement / ctx.total, v_distance / ctx.total
        v_now = v_displacement * pull + v_distance * stretch_now if ctx.needs_input_grad[0] else None
        v_before = v_distance * stretch_before - v_displacement * pull if ctx.needs_input_grad[1] else None
        return v_now, v_before, None, None, None, None


@njit(parallel=True, cache=True, error_model="numpy")
def _weigh_pairs(distances, indices, weights, scale, out):
    # One task per point.
    for i in prange(len(distances)):
        for s in range(distances.shape[1]):
            w = np.exp(-distances[i, s] * distances[i, s] * scale) * weights[i] * weights[indices[i, s]]
            out[i, s] = SUM_EPS if w < SUM_EPS else w  # NaN stays


@njit(cache=True)
def _list_incoming(indices, weights, starts, sources, incoming):
    # Counting sort of the pairs by neighbor: sources[starts[j]:starts[j + 1]] are the points that have neighbor j,
    # increasing, and `incoming` holds the weights of those pairs.
    num, k = indices.shape
    cursors = np.zeros(num, np.int64)
    for i in range(num):
        for s in range(k):
            cursors[indices[i, s]] += 1
    for j in range(num):
        starts[j + 1] = starts[j] + cursors[j]
        cursors[j] = starts[j]
    for i in range(num):
        for s in range(k):
            place = cursors[indices[i, s]]
            cursors[indices[i, s]] = place + 1
            sources[place], incoming[place] = i, weights[i, s]


@njit(cache=True, forceinline=True, fastmath=REORDERED)
def _pair(now, before, i, j, w, constants):
    # Of pair (i, j), times w: displacement and penalty of Eq. (11), then its gradients for point i: the displacement to
    # now_i (to before_i the opposite), the penalty to now_i, and the penalty to before_i.
    half, delta, factor, eps = constants[0], constants[1], constants[2], constants[3]
    ax, ay, az = now[i, 0] - now[j, 0], now[i, 1] - now[j, 1], now[i, 2] - now[j, 2]
    bx, by, bz = before[i, 0] - before[j, 0], before[i, 1] - before[j, 1], before[i, 2] - before[j, 2]
    dx, dy, dz = ax - bx, ay - by, az - bz
    displacement = np.sqrt(dx * dx + dy * dy + dz * dz + eps)
    length_now = np.sqrt(ax * ax + ay * ay + az * az + eps * eps)
    length_before = np.sqrt(bx * bx + by * by + bz * bz + eps * eps)
    stretch = length_now - length_before
    slope = min(max(stretch, -delta), delta)
    penalty = factor * slope * (stretch - half * slope)
    p, q, r = w / displacement, w * factor * slope / length_now, -w * factor * slope / length_before
    return w * displacement, w * penalty, p * dx, p * dy, p * dz, q * ax, q * ay, q * az, r * bx, r * by, r * bz


@njit(parallel=True, cache=True, fastmath=REORDERED, error_model="numpy")
def _pull(now, before, indices, weights, starts, sources, incoming, constants, grads, sums):
    # One task per run of points. Writes grads[:, i] (displacement, penalty now, penalty before), of the sums that are
    # not yet divided by the sum of weights, and sums[task]: weights, displacement, penalty.
    num, k = indices.shape
    for task in prange(len(sums)):
        total = top_displacement = top_penalty = 0.0
        for i in range(task * _POINTS_PER_TASK, min(num, (task + 1) * _POINTS_PER_TASK)):
            px = py = pz = nx = ny = nz = bx = by = bz = weight = displacement = penalty = constants[4]
            for s in range(k):
                w = weights[i, s]
                d, h, x0, y0, z0, x1, y1, z1, x2, y2, z2 = _pair(now, before, i, indices[i, s], w, constants)
                weight, displacement, penalty = weight + w, displacement + d, penalty + h
                px, py, pz = px + x0, py + y0, pz + z0
                nx, ny, nz = nx + x1, ny + y1, nz + z1
                bx, by, bz = bx + x2, by + y2, bz + z2
            for e in range(starts[i], starts[i + 1]):
                _, _, x0, y0, z0, x1, y1, z1, x2, y2, z2 = _pair(now, before, i, sources[e], incoming[e], constants)
                px, py, pz = px + x0, py + y0, pz + z0
                nx, ny, nz = nx + x1, ny + y1, nz + z1
                bx, by, bz = bx + x2, by + y2, bz + z2
            grads[0, i, 0], grads[0, i, 1], grads[0, i, 2] = px, py, pz
            grads[1, i, 0], grads[1, i, 1], grads[1, i, 2] = nx, ny, nz
            grads[2, i, 0], grads[2, i, 1], grads[2, i, 2] = bx, by, bz
            total, top_displacement, top_penalty = (
                total + weight,
                top_displacement + displacement,
                top_penalty + penalty,
            )
        sums[task, 0], sums[task, 1], sums[task, 2] = total, top_displacement, top_penalty
