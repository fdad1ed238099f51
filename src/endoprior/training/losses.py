"""The terms of Eq. (12) that compare one rendered image with its frame, and the term that holds motion to its tracks.

Tracks are supervision too: a Gaussian stays on the track that optical flow gave it, wherever flow really saw it. Color
alone cannot tell which point of flat tissue went where: without this term, training lets tissue slide.
`N` Gaussians, `P` tracks, `T` training frames, `B` basis functions.

The supervised terms are there twice: in PyTorch, and in Numba with value and gradient in one pass over the image. A
dozen small torch operations and their backward passes each read the whole image, which costs as much as rendering it.
Sums run over rows, then over the rows in order, so they are bit-identical whatever the number of threads.
"""

# pyright: reportCallIssue=false
from __future__ import annotations

from typing import TYPE_CHECKING, Any

import numpy as np
import torch
from numba import njit, prange
from torch import Tensor
from torch.autograd.function import once_differentiable

from ..compute.fastmath import REORDERED
from ..core.config import LossConfig
from ..core.types import RenderOutput
from .frames import TrainingFrame

if TYPE_CHECKING:
    from .ops import TrainingOps

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


def supervised_terms(out: RenderOutput, frame: TrainingFrame, cfg: LossConfig, ops: TrainingOps) -> dict[str, Tensor]:
    """Weighted color, depth, total-variation and edge terms, and that of what is hidden, () each."""
    depth_weight = cfg.depth_weight if frame.num_measured >= MIN_DEPTH_PIXELS else 0.0
    fused = ops.supervised_losses(
        out.color,
        out.depth,
        frame.rgb_u8,
        frame.inverse_depth,
        frame.counted(frame.tissue_mask),
        frame.counted(frame.measured),
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
        _rows(*arrays, tv_on_tissue, inverse, factors, v_color, v_depth, sums)
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
