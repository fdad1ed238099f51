"""The temporal term, Eqs. (10) and (11), of chosen Gaussians: in PyTorch for any device, and in Numba for the CPU.

`P` points, `K` neighbors of each. "now" is frame t, "before" the adjacent training frame t - dt. Numba computes value
and gradient together, in few passes. A pair (i, j) pulls on both of its points. Each point therefore visits its own
neighbors and then those whose neighbor it is, in order of their index, so no task writes another's row. Sums are taken
per run of points, then over runs in order: they are bit-identical whatever the number of threads.
"""

# pyright: reportCallIssue=false
from __future__ import annotations

from typing import Any

import numpy as np
import torch
from numba import njit, prange
from numpy.typing import NDArray
from torch import Tensor
from torch.autograd.function import once_differentiable

from ..compute.neighbors import MAX_COORDINATE, nearest
from ..compute.parallel_kernels import parallel_njit
from ..compute.simd import REORDERED
from ..core.checks import check_shape

NUM_NEIGHBORS = 8  # K
HUBER_DELTA = 0.01  # delta of Huber's penalty, mm
SQRT_EPS = 1e-8  # under the root of the displacement norm, mm**2: a finite gradient at zero
SUM_EPS = 1e-8
"""Least pair weight, and least sum of them; a larger one would silence the term: typical weights are near 0.002."""
POINTS_AT_A_TIME = 4096  # points whose distances to all others are held at once in PyTorch
POINTS_PER_TASK = 256


def local_consistency(now: Tensor, before: Tensor, weights: Tensor, smooth_l1: bool = False) -> tuple[Tensor, Tensor]:
    """L_local, Eq. (11), unweighted: neighbors are found and weighed at t - dt, then compared.

    Args:
        now, before: (P, 3) deformed centers at t and t - dt, mm, P > K. Detach `before` to train one end only.
        weights: (P,) motion weights > 0, from `temporal.choose`. smooth_l1: see `huber`.
    Returns:
        Mean |d_i - d_j| (mm) and mean Huber penalty of the change of |mu_i - mu_j|, both weighted by w_ij.
    """
    indices, distances = neighbors(before.detach(), NUM_NEIGHBORS)
    return local_motion(now, before, indices, affinity(distances, indices, weights), smooth_l1)


def neighbors(points: Tensor, k: int) -> tuple[Tensor, Tensor]:
    """(P, k) indices of the nearest other points of each of (P, 3) points, nearest first, and (P, k) distances, mm."""
    found = []
    for start in range(0, len(points), POINTS_AT_A_TIME):
        part = points[start : start + POINTS_AT_A_TIME]
        distances = torch.cdist(part, points, compute_mode="donot_use_mm_for_euclid_dist")
        distances.diagonal(start).fill_(torch.inf)
        found.append(distances.topk(k, largest=False))
    return torch.cat([f.indices for f in found]), torch.cat([f.values for f in found])


def affinity(distances: Tensor, indices: Tensor, weights: Tensor) -> Tensor:
    """(P, K) pair weights w_ij = exp(-|mu_i - mu_j|^2 / (2 sigma_loc^2)) w_i w_j, Eq. (10), floored at `SUM_EPS`.

    sigma_loc, which the paper leaves open, is the median neighbor distance of the iteration (released code).
    """
    sigma = distances.flatten().quantile(0.5).clamp(min=1e-8)  # as in NumPy, between the middle two of an even number
    return ((-(distances**2) / (2 * sigma**2)).exp() * weights[:, None] * weights[indices]).clamp(min=SUM_EPS)


def local_motion(
    now: Tensor, before: Tensor, indices: Tensor, pair_weights: Tensor, smooth_l1: bool = False
) -> tuple[Tensor, Tensor]:
    """The two weighted means of Eq. (11), displacement and distance, of given (P, K) neighbors and pair weights."""
    weight = pair_weights.to(now.dtype)
    weight = weight / weight.sum().clamp(min=SUM_EPS)
    displacement = now - before
    difference = displacement[:, None] - displacement[indices]
    apart = (difference.square().sum(-1) + SQRT_EPS).sqrt()
    stretch = (_length(now[:, None] - now[indices]) - _length(before[:, None] - before[indices])).abs()
    return (weight * apart).sum(), (weight * huber(stretch, HUBER_DELTA, smooth_l1)).sum()


def huber(x: Tensor, delta: float, smooth_l1: bool = False) -> Tensor:
    """Huber's penalty of x >= 0: x^2 / 2 up to delta, delta (x - delta / 2) above; `smooth_l1` divides it by delta."""
    literal = torch.where(x <= delta, 0.5 * x * x, delta * (x - 0.5 * delta))
    return literal / delta if smooth_l1 else literal


def _length(vectors: Tensor) -> Tensor:
    return (vectors.square().sum(-1) + SQRT_EPS**2).sqrt()


def local_consistency_numba(
    now: Tensor, before: Tensor, weights: Tensor, smooth_l1: bool = False
) -> tuple[Tensor, Tensor]:
    """See `local_consistency`."""
    indices, distances = neighbors_numba(before.detach().numpy(), NUM_NEIGHBORS)
    return local_motion_numba(now, before, indices, affinity_numba(distances, indices, weights.numpy()), smooth_l1)


def neighbors_numba(points: NDArray, k: int) -> tuple[NDArray[np.intp], NDArray]:
    """See `neighbors`; of equally near points those with the smallest indices.

    Raises:
        ValueError: not 0 < k < P, or a coordinate that is not finite or too large to be squared.
    """
    check_shape("points:P,3", points=points)
    if not 0 < k < len(points):
        raise ValueError(f"k must be in [1, {len(points) - 1}], the number of other points; got {k}")
    if not float(np.abs(points).max()) <= MAX_COORDINATE:
        raise ValueError(f"points must be finite, of magnitude up to {MAX_COORDINATE:g} mm")
    return nearest(np.ascontiguousarray(points), k)


def affinity_numba(distances: NDArray[np.float64], indices: NDArray[np.intp], weights: NDArray) -> NDArray[np.float64]:
    """See `affinity`."""
    sigma = max(float(np.median(distances)), 1e-8)
    out = np.empty(distances.shape)
    _weigh_pairs(distances, indices, weights, 1 / (2 * sigma**2), out)
    return out


def local_motion_numba(
    now: Tensor, before: Tensor, indices: NDArray[np.intp], pair_weights: NDArray, smooth_l1: bool = False
) -> tuple[Tensor, Tensor]:
    """See `local_motion`; the gradient flows to `now` and `before`.

    Raises:
        ValueError: shapes or types disagree, or an index is out of range.
    """
    shapes = "now:P,3 before:P,3 indices:P,K pair_weights:P,K"
    check_shape(shapes, now=now, before=before, indices=indices, pair_weights=pair_weights)
    if now.dtype != before.dtype:
        raise ValueError(f"before must have the type of now, {now.dtype}; got {before.dtype}")
    if not 0 <= indices.min() <= indices.max() < len(now):
        raise ValueError(f"indices must be in [0, {len(now) - 1}]; got {indices.min()} to {indices.max()}")
    factor = 1 / HUBER_DELTA if smooth_l1 else 1.0
    return _LocalMotion.apply(now, before, indices, pair_weights, factor)


class _LocalMotion(torch.autograd.Function):
    @staticmethod
    def forward(ctx: Any, now, before, indices, weights, factor) -> tuple[Tensor, Tensor]:
        a, b = (t.detach().contiguous().numpy() for t in (now, before))
        num = len(a)
        weights = np.ascontiguousarray(weights, dtype=a.dtype)
        starts, sources, incoming = np.zeros(num + 1, np.int64), np.empty(0, np.int32), np.empty(0, a.dtype)
        if any(ctx.needs_input_grad):
            sources, incoming = np.empty(indices.size, np.int32), np.empty(indices.size, a.dtype)
            _list_incoming(indices, weights, starts, sources, incoming)
        grads = np.empty((3, num, 3), a.dtype)
        sums = np.empty((-(-num // POINTS_PER_TASK), 3))
        constants = np.array([0.5, HUBER_DELTA, factor, SQRT_EPS, 0.0], a.dtype)
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
        return v_now, v_before, None, None, None


@parallel_njit(error_model="numpy")
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


@parallel_njit(fastmath=REORDERED, error_model="numpy")
def _pull(now, before, indices, weights, starts, sources, incoming, constants, grads, sums):
    # One task per run of points. Writes grads[:, i] (displacement, penalty now, penalty before), of the sums that are
    # not yet divided by the sum of weights, and sums[task]: weights, displacement, penalty.
    num, k = indices.shape
    for task in prange(len(sums)):
        total = top_displacement = top_penalty = 0.0
        for i in range(task * POINTS_PER_TASK, min(num, (task + 1) * POINTS_PER_TASK)):
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
            total += weight
            top_displacement += displacement
            top_penalty += penalty
        sums[task, 0], sums[task, 1], sums[task, 2] = total, top_displacement, top_penalty
