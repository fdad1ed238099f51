"""The supervised terms of Eq. (12) in Numba: values and gradients in one pass over the image. CPU, float32.

Computes what `losses.py` computes. A dozen small torch operations and their backward passes each read the whole
image, which costs as much as rendering it; here each row of pixels is read once. Sums run over rows, then over the rows
in order, so they are bit-identical whatever the number of threads.
"""

# pyright: reportCallIssue=false
from __future__ import annotations

from typing import Any

import numpy as np
import torch
from numba import njit, prange
from torch import Tensor
from torch.autograd.function import once_differentiable

from ..compute.fastmath import REORDERED


def supervised_losses(
    color: Tensor,
    depth: Tensor,
    target_u8: Tensor,
    target_inverse: Tensor,
    tissue_mask: Tensor,
    measured: Tensor,
    weights: tuple[float, float, float, float],
    tv_on_tissue: bool = True,
) -> Tensor:
    """See `losses.supervised_losses`. The terms must be summed, not scaled: their gradients are added already."""
    return _SupervisedLosses.apply(
        color, depth, target_u8, target_inverse, tissue_mask, measured, weights, tv_on_tissue
    )


class _SupervisedLosses(torch.autograd.Function):
    @staticmethod
    def forward(
        ctx: Any, color, depth, target_u8, target_inverse, tissue_mask, measured, weights, tv_on_tissue
    ) -> Tensor:
        height, width = depth.shape
        arrays = [
            t.detach().contiguous().numpy() for t in (color, depth, target_u8, target_inverse, tissue_mask, measured)
        ]
        num_color, num_depth = (max(np.count_nonzero(mask), 1) for mask in arrays[4:])
        num_pixels = height * width
        color, depth, tv, edges = weights
        by_color = [color / (3 * num_color), edges / (3 * num_color)]
        factors = np.array([*by_color, depth / num_depth, tv / (3 * num_pixels), tv / num_pixels], np.float32)
        v_color, v_depth = np.empty_like(arrays[0]), np.empty_like(arrays[1])
        inverse = np.empty_like(arrays[1])
        sums = np.zeros((height, 5), np.float64)
        _invert(arrays[1], inverse)
        _rows(*arrays, tv_on_tissue, inverse, factors, v_color, v_depth, sums)
        ctx.grads = torch.from_numpy(v_color), torch.from_numpy(v_depth)
        totals = sums.sum(0) * factors
        return torch.tensor([totals[0], totals[2], totals[3] + totals[4], totals[1]], dtype=torch.float32)

    @staticmethod
    @once_differentiable
    def backward(ctx: Any, v_terms: Tensor) -> tuple:
        # Gradients of the four terms are already added up: valid only if all are summed with weight one.
        if not bool((v_terms == 1).all()):
            raise ValueError("the terms of supervised_losses must be added, not scaled; pass `weights` instead")
        return *ctx.grads, None, None, None, None, None, None


@njit(parallel=True, cache=True, fastmath=REORDERED)
def _invert(depth, inverse):
    for y in prange(depth.shape[0]):
        for x in range(depth.shape[1]):
            d = depth[y, x]
            inverse[y, x] = np.float32(1) / d if d != 0 else np.float32(0)


@njit(cache=True, inline="always")
def _sign(x):
    return np.float32(x > 0) - np.float32(x < 0)


@njit(parallel=True, cache=True, fastmath=REORDERED)
def _rows(
    color, depth, target_u8, target_inverse, tissue_mask, measured, tv_on_tissue, inverse, factors,
    v_color, v_depth, sums,
):  # fmt: skip
    # One task per row y: writes v_color[y], v_depth[y], sums[y]: the unweighted (color, edges, depth, two variations).
    # A variation's gradient is the signs of the differences to the four neighbors: no task writes another's row.
    # A row is one flat run of numbers, three per pixel for color: loops over it vectorize, loops over channels do not.
    height, width = depth.shape
    scale, one = np.float32(1 / 255), np.float32(1)
    f_color, f_edges, f_depth, f_tv, f_tvd = factors
    colors, targets = color.reshape(height, 3 * width), target_u8.reshape(height, 3 * width)
    v_colors = v_color.reshape(height, 3 * width)
    for y in prange(height):
        up, down = max(y - 1, 0), min(y + 1, height - 1)
        # 1 on tissue in this row, the one above and the one below; then where both pixels of a difference are tissue:
        # to the row above, the row below, the next pixel.
        tissue, both = np.empty((3, 3 * width), np.float32), np.zeros((3, 3 * width), np.float32)
        _fill_colors(tissue_mask[y], tissue[0])
        _fill_colors(tissue_mask[up], tissue[1])
        _fill_colors(tissue_mask[down], tissue[2])
        both[0], both[1] = tissue[0] * tissue[1], tissue[0] * tissue[2]
        both[2, :-3] = tissue[0, :-3] * tissue[0, 3:]
        sums[y, 0] = _fidelity(colors[y], targets[y], scale, tissue[0], f_color, v_colors[y])
        if f_edges > 0:
            errors = np.empty((3, 3 * width), np.float32)
            _fill_errors(colors[up], targets[up], scale, errors[0])
            _fill_errors(colors[y], targets[y], scale, errors[1])
            _fill_errors(colors[down], targets[down], scale, errors[2])
            sums[y, 1] = _variation(errors[0], errors[1], errors[2], 3, f_edges, both, v_colors[y])
        if tv_on_tissue:
            both[:] = one
        else:
            both[:] = one - both
        sums[y, 3] = _variation(colors[up], colors[y], colors[down], 3, f_tv, both, v_colors[y])
        weight = np.empty(width, np.float32)
        for x in range(width):
            weight[x] = np.float32(measured[y, x])
            for k in range(3):
                both[k, x] = both[k, 3 * x]
        sums[y, 2] = _fidelity(inverse[y], target_inverse[y], one, weight, f_depth, v_depth[y])
        sums[y, 4] = _variation(inverse[up], inverse[y], inverse[down], 1, f_tvd, both, v_depth[y])
        for x in range(width):
            v_depth[y, x] *= -inverse[y, x] * inverse[y, x]


@njit(cache=True, inline="always")
def _fidelity(row, target, scale, weight, factor, v_row):
    # Weighted sum of |row - scale * target|; sets v_row to `factor` times its gradient.
    total = np.float32(0)
    for i in range(len(row)):
        e = row[i] - np.float32(target[i]) * scale
        total += weight[i] * abs(e)
        v_row[i] = factor * weight[i] * _sign(e)
    return total


@njit(cache=True, inline="always")
def _fill_colors(mask, values):
    # Writes a mask (W,) as 0 and 1, three numbers per pixel.
    for x in range(len(mask)):
        values[3 * x] = values[3 * x + 1] = values[3 * x + 2] = np.float32(mask[x])


@njit(cache=True, inline="always")
def _fill_errors(row, target, scale, errors):
    for i in range(len(row)):
        errors[i] = row[i] - np.float32(target[i]) * scale


@njit(cache=True, inline="always")
def _variation(above, row, below, step, factor, counted, v_row):
    # Weighted sum of |differences| to the next pixel, `step` numbers on, and to the row below; adds `factor` times the
    # gradient of the whole image's variation to v_row. `counted` (3, .): weights of the differences to the row above,
    # the row below and the next pixel.
    total = np.float32(0)
    size = len(row)
    for i in range(size):
        total += counted[1, i] * abs(below[i] - row[i])
        v_row[i] += factor * (counted[0, i] * _sign(row[i] - above[i]) - counted[1, i] * _sign(below[i] - row[i]))
    for i in range(size - step):
        total += counted[2, i] * abs(row[i + step] - row[i])
        v_row[i] -= factor * counted[2, i] * _sign(row[i + step] - row[i])
    for i in range(step, size):
        v_row[i] += factor * counted[2, i - step] * _sign(row[i] - row[i - step])
    return total
