"""The supervised terms of Eq. (12) in one pass: values and gradients together, for the training loop on a CPU.

`losses.py` defines the terms; this must agree with it. A dozen small torch operations and their backward each walk the
whole image, which costs as much as drawing it; here each row of pixels is read once. Sums are taken per row, then over
rows in order, so they repeat bit for bit whatever the number of threads.
"""

from __future__ import annotations

from typing import Any

import numpy as np
import torch
from numba import njit, prange
from torch import Tensor
from torch.autograd.function import once_differentiable

FLAGS = {"reassoc", "contract", "nsz", "arcp", "afn"}


def supervised_losses(
    color: Tensor,
    depth: Tensor,
    target_u8: Tensor,
    target_inverse: Tensor,
    tissue_mask: Tensor,
    measured: Tensor,
    weights: tuple[float, float, float],
) -> Tensor:
    """Weighted color, depth and total-variation terms; the gradient flows to `color` and `depth`.

    Args:
        color: (H, W, 3) float32. depth: (H, W) float32 mm, 0 where nothing is drawn.
        target_u8: (H, W, 3) uint8. target_inverse: (H, W) 1 / mm.
        tissue_mask, measured: (H, W) bool, True where color, respectively depth, is compared.
        weights: factors of the three terms; the depth term is 0 where its factor is.
    Returns:
        (3,) the weighted terms.
    """
    return _SupervisedLosses.apply(color, depth, target_u8, target_inverse, tissue_mask, measured, weights)


class _SupervisedLosses(torch.autograd.Function):
    @staticmethod
    def forward(ctx: Any, color, depth, target_u8, target_inverse, tissue_mask, measured, weights) -> Tensor:
        height, width = depth.shape
        num_color = max(float(tissue_mask.sum()) * 3, 1.0)
        num_depth = max(float(measured.sum()), 1.0)
        factors = np.array(
            [
                weights[0] / num_color,
                weights[1] / num_depth,
                weights[2] / (height * width * 3),
                weights[2] / depth.numel(),
            ],
            np.float32,
        )
        arrays = [
            t.detach().contiguous().numpy() for t in (color, depth, target_u8, target_inverse, tissue_mask, measured)
        ]
        v_color, v_depth = np.empty_like(arrays[0]), np.empty_like(arrays[1])
        inverse = np.empty_like(arrays[1])
        sums = np.zeros((height, 4), np.float64)
        _invert(arrays[1], inverse)
        _rows(*arrays, inverse, factors, v_color, v_depth, sums)
        ctx.grads = torch.from_numpy(v_color), torch.from_numpy(v_depth)
        totals = sums.sum(0) * factors
        return torch.tensor([totals[0], totals[1], totals[2] + totals[3]], dtype=torch.float32)

    @staticmethod
    @once_differentiable
    def backward(ctx: Any, v_terms: Tensor) -> tuple:
        # Gradients of the three terms are already added up: valid only if all are summed with weight one.
        if not bool((v_terms == 1).all()):
            raise ValueError("the terms of supervised_losses must be added, not scaled; pass `weights` instead")
        return *ctx.grads, None, None, None, None, None


@njit(parallel=True, cache=True, fastmath=FLAGS)
def _invert(depth, inverse):
    for y in prange(depth.shape[0]):
        for x in range(depth.shape[1]):
            d = depth[y, x]
            inverse[y, x] = np.float32(1) / d if d != 0 else np.float32(0)


@njit(cache=True, inline="always")
def _sign(x):
    return np.float32(x > 0) - np.float32(x < 0)


@njit(parallel=True, cache=True, fastmath=FLAGS)
def _rows(color, depth, target_u8, target_inverse, tissue_mask, measured, inverse, factors, v_color, v_depth, sums):
    # One task per row y: writes v_color[y], v_depth[y] and sums[y], the unweighted (color, depth, two variations).
    # The variation's gradient is the signs of the differences to the four neighbors: no task writes another's row.
    height, width = depth.shape
    scale = np.float32(1 / 255)
    f_color, f_depth, f_tv, f_tvd = factors
    for y in prange(height):
        s_color = s_depth = s_tv = s_tvd = np.float32(0)
        up, down = max(y - 1, 0), min(y + 1, height - 1)
        for x in range(width):
            left, right = max(x - 1, 0), min(x + 1, width - 1)
            tissue, known = np.float32(tissue_mask[y, x]), np.float32(measured[y, x])
            for k in range(3):
                c = color[y, x, k]
                e = c - np.float32(target_u8[y, x, k]) * scale
                s_color += tissue * abs(e)
                to_right, to_down = color[y, right, k] - c, color[down, x, k] - c
                s_tv += abs(to_right) + abs(to_down)
                pull = _sign(c - color[y, left, k]) + _sign(c - color[up, x, k]) - _sign(to_right) - _sign(to_down)
                v_color[y, x, k] = f_color * tissue * _sign(e) + f_tv * pull
            q = inverse[y, x]
            e = q - target_inverse[y, x]
            s_depth += known * abs(e)
            to_right, to_down = inverse[y, right] - q, inverse[down, x] - q
            s_tvd += abs(to_right) + abs(to_down)
            pull = _sign(q - inverse[y, left]) + _sign(q - inverse[up, x]) - _sign(to_right) - _sign(to_down)
            v_depth[y, x] = -q * q * (f_depth * known * _sign(e) + f_tvd * pull)
        sums[y, 0], sums[y, 1], sums[y, 2], sums[y, 3] = s_color, s_depth, s_tv, s_tvd
