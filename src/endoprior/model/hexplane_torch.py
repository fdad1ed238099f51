"""HexPlane features in PyTorch, on any device; `hexplane_numba.py` computes the same.

The time planes are interpolated at each time first; a feature is then a product of three bilinear and three linear
look-ups. Each look-up is a weighted sum of a few rows of one matrix, whose gradient is added to the rows of
`PlaneGrid.grads`: autograd would allocate a gradient of all planes, hundreds of megabytes, for each of the twenty-four.

Letters: `N` positions, `S` scales, `C` channels, `R` rows of the interpolated time planes.
"""

from __future__ import annotations

from typing import Any

import torch
from torch import Tensor
from torch.autograd.function import once_differentiable
from torch.nn.functional import embedding_bag, linear

from ..core.checks import check_shape
from .hexplane import FRESH, TOUCHED, PlaneGrid


def hexplane_linear(
    grid: PlaneGrid, unit: Tensor, times: tuple[float, ...], weight: Tensor, bias: Tensor
) -> tuple[Tensor, ...]:
    """A linear layer on the features at one or more times.

    Args:
        unit: (N, 3) float32 positions, 0..1 from the first to the second corner of the box; clamped outside.
        times: M of them in [0, 1]. weight: (W, S * C). bias: (W,).
    Returns:
        (N, W) float32 per time. With gradients enabled, backward also adds to `grid.grads`.
    Raises:
        ValueError: a wrong shape.
    """
    check_shape(f"unit:N,3 weight:W,{grid.num_features} bias:W", unit=unit, weight=weight, bias=bias)
    return tuple(linear(found, weight, bias) for found in features(grid, unit, times))


def features(grid: PlaneGrid, unit: Tensor, times: tuple[float, ...]) -> tuple[Tensor, ...]:
    """Features (N, S * C) float32 per time; arguments as `hexplane_linear`. The space planes are read once for all."""
    layout = grid.layout
    tables = [_at_time(grid, time) for time in times]
    parts: list[list[Tensor]] = [[] for _ in times]
    for scale in range(grid.num_scales):
        position = unit.clamp(0, 1) * (layout.resolution[scale] - 1)
        # A position without a value must not become an address.
        low = torch.minimum(position.detach().nan_to_num(0).floor(), layout.resolution[scale] - 2)
        share, low = position - low, low.to(torch.int64)
        space = _product(_bilinear(grid, scale, low, share))
        rows = (layout.table_start[scale] + low)[..., None] + torch.arange(2, device=unit.device)
        weights = torch.stack([1 - share, share], -1)
        for part, table in zip(parts, tables, strict=True):
            part.append(space * _product(_sums(weights, rows, table, None)))
    return tuple(torch.cat(part, -1) for part in parts)


def _at_time(grid: PlaneGrid, time: float) -> Tensor:
    """(R, C) the time planes, interpolated at `time`."""
    layout = grid.layout
    row, fraction = grid.time_row(time)
    below = layout.time_first + row * layout.time_step
    rows = torch.stack([below, below + layout.time_step], -1)
    weights = rows.new_tensor([1 - fraction, fraction], dtype=torch.float32).expand(len(rows), 2).contiguous()
    return _sums(weights.requires_grad_(torch.is_grad_enabled()), rows, grid.values, grid)


def _bilinear(grid: PlaneGrid, scale: int, low: Tensor, share: Tensor) -> Tensor:
    """(N, 3, C) samples of the planes xy, xz, yz of a scale; `low` (N, 3) cells and `share` (N, 3) along x, y, z."""
    x, y, z = low.unbind(-1)
    width = grid.layout.space_width[scale]
    corner = grid.layout.space_start[scale] + torch.stack([x, x, y], -1) + torch.stack([y, z, z], -1) * width
    rows = torch.stack([corner, corner + 1, corner + width, corner + width + 1], -1)
    x, y, z = share.unbind(-1)
    along, across = torch.stack([x, x, y], -1), torch.stack([y, z, z], -1)
    near, far = torch.stack([1 - along, along], -1), torch.stack([1 - across, across], -1)
    weights = (far[..., :, None] * near[..., None, :]).flatten(-2)
    return _sums(weights, rows, grid.values, grid)


def _product(factors: Tensor) -> Tensor:
    """(N, C) product of (N, 3, C)."""
    a, b, c = factors.unbind(1)
    return a * b * c


def _sums(weights: Tensor, rows: Tensor, source: Tensor, grid: PlaneGrid | None) -> Tensor:
    """(..., C) sums over k of weights (..., k) times rows (..., k) of `source`: `values` of `grid`, or a table."""
    found = _Sums.apply(weights.flatten(0, -2), rows.flatten(0, -2), source, grid)
    return found.view(*weights.shape[:-1], -1)


class _Sums(torch.autograd.Function):
    """Sums of a few rows each; the gradient of the source is returned, or added to the buffer of its grid."""

    @staticmethod
    def forward(ctx: Any, weights: Tensor, rows: Tensor, source: Tensor, grid: PlaneGrid | None) -> Tensor:
        """`weights` (M, k) float32, `rows` (M, k) int64, `source` (R, C) float32 or float16; (M, C) float32."""
        ctx.save_for_backward(weights, rows, source)
        ctx.grid = grid
        found = embedding_bag(rows, source, per_sample_weights=weights.to(source.dtype), mode="sum")
        return found.to(weights.dtype)

    @staticmethod
    @once_differentiable
    def backward(ctx: Any, v_found: Tensor) -> tuple[Tensor, None, Tensor | None, None]:
        weights, rows, source = ctx.saved_tensors
        v_weights = torch.bmm(source[rows], v_found[..., None])[..., 0]
        # Rows are sorted before they are added up, so that on a GPU equal input gives equal bits.
        adding = {"values": (weights[..., None] * v_found[:, None]).flatten(0, 1), "accumulate": True}
        if ctx.grid is None:
            return v_weights, None, torch.zeros_like(source).index_put_((rows.flatten(),), **adding), None
        ctx.grid.grads.index_put_((rows.flatten(),), **adding)
        ctx.grid.marks.fill_(TOUCHED | FRESH)
        return v_weights, None, None, None
