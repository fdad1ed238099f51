"""The terms of Eq. (12) that compare one rendered image with its frame.

The terms are there twice: in PyTorch, and in Numba with value and gradient in one pass over the image. A
dozen small torch operations and their backward passes each read the whole image, which costs as much as rendering it.
Sums run over rows, then over the rows in order, so they are bit-identical whatever the number of threads.
"""

# pyright: reportCallIssue=false
from __future__ import annotations

from collections.abc import Callable
from typing import Any

import numpy as np
import torch
from numba import njit, prange
from torch import Tensor
from torch.autograd.function import once_differentiable

from ..compute.parallel_kernels import parallel_njit
from ..compute.simd import REORDERED
from ..core.config import LossConfig
from ..core.types import RenderOutput
from .frames import TrainingFrame

BAND = 16  # rows per task
MIN_DEPTH_PIXELS = 10  # a frame with fewer pixels of measured tissue depth gets no depth loss


def color_l1(color: Tensor, target: Tensor, tissue_mask: Tensor) -> Tensor:
    """L_rgb: mean absolute difference of (H, W, 3) colors over tissue pixels (H, W) and channels.

    Like the other terms, it also takes weights in [0, 1] for a mask; pixels count by their weight, and the sum is
    divided by the number of pixels of any, so that a frame of low weight counts less.
    """
    count = (_num(tissue_mask) * color.shape[-1]).clamp(min=1)
    return ((color - target).abs() * tissue_mask[..., None]).sum() / count


def edge_l1(color: Tensor, target: Tensor, tissue_mask: Tensor) -> Tensor:
    """L_edge: absolute difference of image gradients, summed over both axes, mean over tissue pixels and channels.

    Gradients are forward differences between two pixels of tissue, as in the gradient difference loss of Mathieu
    et al. 2016, but of gradients with their signs.
    """
    error = color - target
    down = (error[1:] - error[:-1]).abs() * (tissue_mask[1:] * tissue_mask[:-1])[..., None]
    right = (error[:, 1:] - error[:, :-1]).abs() * (tissue_mask[:, 1:] * tissue_mask[:, :-1])[..., None]
    return (down.sum() + right.sum()) / (_num(tissue_mask) * color.shape[-1]).clamp(min=1)


def inverse_depth(depth: Tensor) -> Tensor:
    """1 / depth where depth is not 0, else 0; same shape, 1 / mm."""
    rendered = depth != 0
    return torch.where(rendered, 1 / torch.where(rendered, depth, 1), 0)


def inverse_depth_l1(inverse: Tensor, target: Tensor, measured: Tensor) -> Tensor:
    """L_depth: mean absolute difference of inverse depths (H, W) over `measured` tissue pixels, 1 / mm."""
    return ((inverse - target).abs() * measured).sum() / _num(measured).clamp(min=1)


def _num(counted: Tensor) -> Tensor:
    """Number of pixels that count, ()."""
    return (counted > 0).sum()


def total_variation(image: Tensor, left_out: Tensor | None = None) -> Tensor:
    """Sum of absolute forward differences of (H, W) or (H, W, C) along both axes, divided by the number of values.

    Differences between two pixels of `left_out` (H, W) do not count; where it holds weights, they count the less.
    """
    down, right = (image[1:] - image[:-1]).abs(), (image[:, 1:] - image[:, :-1]).abs()
    if left_out is not None:
        shape = (*left_out.shape, *[1] * (image.ndim - 2))
        out = left_out.reshape(shape).to(image.dtype)
        down, right = down * (1 - out[1:] * out[:-1]), right * (1 - out[:, 1:] * out[:, :-1])
    return (down.sum() + right.sum()) / image.numel()


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
    """Weighted color, depth, total-variation and edge terms.

    Args:
        color: (H, W, 3) float32. depth: (H, W) float32 mm, 0 where nothing is rendered.
        target_u8: (H, W, 3) uint8. target_inverse: (H, W) 1 / mm.
        tissue_mask, measured: (H, W) bool, True where color, respectively depth, is compared; or weights in [0, 1].
        weights: factors of the four terms; the depth term is 0 where its factor is.
        tv_on_tissue: whether the total variation counts between two pixels of tissue.
    Returns:
        (4,) the weighted terms, differentiable in `color` and `depth`.
    """
    inverse, left_out = inverse_depth(depth), None if tv_on_tissue else tissue_mask
    target = target_u8.float() / 255
    terms = [
        color_l1(color, target, tissue_mask),
        inverse_depth_l1(inverse, target_inverse, measured),
        total_variation(color, left_out) + total_variation(inverse, left_out),
        edge_l1(color, target, tissue_mask),
    ]
    return torch.stack([weight * term for weight, term in zip(weights, terms, strict=True)])


def supervised_terms(
    out: RenderOutput, frame: TrainingFrame, cfg: LossConfig, losses: Callable[..., Tensor]
) -> dict[str, Tensor]:
    """Weighted color, depth, total-variation and edge terms, and that of what is hidden, () each.

    Args:
        losses: the implementation of `supervised_losses`, of `TrainingOps`.
    """
    depth_weight = cfg.depth_weight if frame.num_measured >= MIN_DEPTH_PIXELS else 0.0
    fused = losses(
        out.color,
        out.depth,
        frame.rgb_u8,
        frame.inverse_depth,
        frame.counted(frame.tissue_mask),
        frame.counted_depth,
        (1.0, depth_weight, cfg.tv_weight, cfg.edge_weight),
        not cfg.cover_weight,
    )
    names: list[str] = ["color", "depth", "tv", "edges"]
    terms = dict(zip(names, fused, strict=True))
    if cfg.cover_weight:
        hidden = frame.hidden.to(out.alpha.dtype)
        uncovered = hidden.sum() - torch.dot(out.alpha.flatten(), hidden.flatten())
        terms["cover"] = cfg.cover_weight / hidden.numel() * uncovered
    return terms


def supervised_losses_numba(
    color: Tensor,
    depth: Tensor,
    target_u8: Tensor,
    target_inverse: Tensor,
    tissue_mask: Tensor,
    measured: Tensor,
    weights: tuple[float, float, float, float],
    tv_on_tissue: bool = True,
) -> Tensor:
    """See `supervised_losses`. The terms must be summed, not scaled: their gradients are added already."""
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
        _bands(*arrays, tv_on_tissue, inverse, factors, v_color, v_depth, sums)
        ctx.grads = torch.from_numpy(v_color), torch.from_numpy(v_depth)
        totals = sums.sum(0) * factors
        return torch.tensor([totals[0], totals[2], totals[3] + totals[4], totals[1]], dtype=torch.float32)

    @staticmethod
    @once_differentiable
    def backward(ctx: Any, v_terms: Tensor) -> tuple:
        # Gradients of the four terms are already added up: valid only if all are summed with weight one.
        if not bool((v_terms == 1).all()):
            raise ValueError(
                "expected the terms color, depth, tv and edges as they are; got one that is scaled or left out: their "
                "gradients are added already. Set their weights in config.loss."
            )
        return *ctx.grads, None, None, None, None, None, None


@parallel_njit(fastmath=REORDERED)
def _invert(depth, inverse):
    for y in prange(depth.shape[0]):
        for x in range(depth.shape[1]):
            d = depth[y, x]
            inverse[y, x] = np.float32(1) / d if d != 0 else np.float32(0)


@njit(cache=True, inline="always")
def _sign(x):
    return np.float32(x > 0) - np.float32(x < 0)


@parallel_njit(fastmath=REORDERED)
def _bands(
    color, depth, target_u8, target_inverse, tissue_mask, measured, tv_on_tissue, inverse, factors,
    v_color, v_depth, sums,
):  # fmt: skip
    # One task per BAND rows: writes their v_color and v_depth, and sums[y], unweighted: color, edges, depth, variation
    # of color and of depth. A row is one flat run of numbers, three per pixel for color: loops over it vectorize.
    height, width = depth.shape
    f_color, f_edges, f_depth, f_tv, f_tvd = factors
    f_tissue = np.float32(tv_on_tissue)
    colors, v_colors = color.reshape(height, 3 * width), v_color.reshape(height, 3 * width)
    targets = target_u8.reshape(height, 3 * width)
    for band in prange((height + BAND - 1) // BAND):
        # Of two rows in turn: errors and tissue of color, errors and tissue of depth.
        rows3, rows1 = np.empty((2, 2, 3 * width), np.float32), np.empty((2, 2, width), np.float32)
        # Gradients of the differences to the row above, and to the pixel on the left (`step` numbers later).
        above3, left3 = np.zeros(3 * width, np.float32), np.zeros(3 * width + 3, np.float32)
        above1, left1 = np.zeros(width, np.float32), np.zeros(width + 1, np.float32)
        weight, spare3 = np.empty(width, np.float32), np.empty(3 * width, np.float32)
        begin, end = band * BAND, min((band + 1) * BAND, height)
        first = max(begin - 1, 0)
        _fill(first, colors, targets, inverse, target_inverse, tissue_mask, rows3[first % 2], rows1[first % 2])
        for y in range(first, end):
            here, below = y % 2, min(y + 1, height - 1)
            there = below % 2
            if below > y:
                _fill(below, colors, targets, inverse, target_inverse, tissue_mask, rows3[there], rows1[there])
            for x in range(width):
                weight[x] = np.float32(measured[y, x])
            # The row above a band only gives differences: its own gradient is another task's.
            v3, v1 = (v_colors[y], v_depth[y]) if y >= begin else (spare3, weight)
            shades = rows3[here, 1], rows3[here], rows3[there], colors[y], colors[below]
            near = _differences(*shades, 3, f_color, f_edges, f_tv, f_tissue, above3, left3, v3)
            depths = weight, rows1[here], rows1[there], inverse[y], inverse[below]
            far = _differences(*depths, 1, f_depth, np.float32(0), f_tvd, f_tissue, above1, left1, v1)
            if y >= begin:
                sums[y, 0], sums[y, 1], sums[y, 2], sums[y, 3], sums[y, 4] = near[0], near[1], far[0], near[2], far[2]
                for x in range(width):
                    v_depth[y, x] *= -inverse[y, x] * inverse[y, x]


@njit(cache=True)
def _fill(y, colors, targets, inverse, target_inverse, tissue_mask, row3, row1):
    # Errors and tissue of row y, for color (2, 3 W) and for depth (2, W).
    scale = np.float32(1 / 255)
    for x in range(inverse.shape[1]):
        row1[0, x], row1[1, x] = inverse[y, x] - target_inverse[y, x], np.float32(tissue_mask[y, x])
        row3[1, 3 * x] = row3[1, 3 * x + 1] = row3[1, 3 * x + 2] = row1[1, x]
    for i in range(colors.shape[1]):
        row3[0, i] = colors[y, i] - np.float32(targets[y, i]) * scale


@njit(cache=True, fastmath=REORDERED)
def _differences(weight, here, there, row, below, step, factor, f_edges, f_tv, f_tissue, above, left, v_row):
    # Sums of one row: weighted |error|, |difference of errors| on tissue, |difference of values| elsewhere and, where
    # f_tissue is 1, on tissue, to the row below and to the next pixel. Sets v_row to the gradient. The last row is its
    # own row below: all differences are 0.
    error, tissue, error_below, tissue_below = here[0], here[1], there[0], there[1]
    one, size = np.float32(1), len(row)
    fidelity = edges = variation = np.float32(0)
    for i in range(size):
        fidelity += weight[i] * abs(error[i])
        both = tissue[i] * tissue_below[i]
        free = one - both + f_tissue * both
        of_error, of_value = error_below[i] - error[i], below[i] - row[i]
        edges += both * abs(of_error)
        variation += free * abs(of_value)
        down = f_edges * both * _sign(of_error) + f_tv * free * _sign(of_value)
        v_row[i] = factor * weight[i] * _sign(error[i]) + above[i] - down
        above[i] = down
    for i in range(size - step):
        both = tissue[i] * tissue[i + step]
        free = one - both + f_tissue * both
        of_error, of_value = error[i + step] - error[i], row[i + step] - row[i]
        edges += both * abs(of_error)
        variation += free * abs(of_value)
        left[i + step] = f_edges * both * _sign(of_error) + f_tv * free * _sign(of_value)
    for i in range(size):
        v_row[i] += left[i] - left[i + step]
    return fidelity, edges, variation
