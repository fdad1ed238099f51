"""HexPlane features in torch: what the kernels of `hexplane_kernels.py` compute, and what runs on any other device.

The time planes are cut at each moment first; a feature is then a product of three bilinear and three linear look-ups.
Each look-up is a weighted sum of a few rows of one matrix, whose gradient is added to the rows of `PlaneGrid.grads`:
autograd would make a gradient of all planes, hundreds of megabytes, for each of the twenty-four.

Letters: `N` positions, `S` scales, `C` channels, `R` rows of the cut time planes, `M` sums of `k` rows each.
"""

from __future__ import annotations

from typing import TYPE_CHECKING, Any, NamedTuple

import torch
from torch import Tensor
from torch.autograd.function import once_differentiable
from torch.nn.functional import embedding_bag

from .hexplane_kernels import FRESH, TOUCHED

if TYPE_CHECKING:
    from .hexplane import PlaneGrid


class Layout(NamedTuple):
    """Where the planes lie in `PlaneGrid.values`, as tensors on its device: made once, so that no call copies them."""

    resolution: Tensor
    """(S, 3) float32 cells along x, y, z."""
    space_start: Tensor
    """(S, 3) first row of the planes xy, xz, yz, and"""
    space_width: Tensor
    """(S, 3) how many rows further the next cell along the second letter is."""
    table_start: Tensor
    """(S, 3) first row of the cut planes xt, yt, zt."""
    first_moment: Tensor
    """(R,) row of `values` that holds each cell of the cut planes at the first moment, and"""
    next_moment: Tensor
    """(R,) how many rows further the next moment is."""


def layout_of(grid: PlaneGrid) -> Layout:
    """The layout of a grid on the device of its values."""
    size = torch.from_numpy(grid.resolution)
    first, step = [], []
    for starts, cells in zip(grid.time_start.tolist(), grid.resolution.tolist(), strict=True):
        for start, count in zip(starts, cells, strict=True):
            first.append(start + torch.arange(count))
            step.append(torch.full((count,), count))
    tables = (
        size.float(),
        torch.from_numpy(grid.space_start),
        torch.stack([size[:, 0], size[:, 0], size[:, 1]], 1),
        torch.from_numpy(grid.table_start),
        torch.cat(first),
        torch.cat(step),
    )
    return Layout(*(table.to(grid.values.device) for table in tables))


def features(grid: PlaneGrid, unit: Tensor, times: tuple[float | Tensor, ...]) -> tuple[Tensor, ...]:
    """`PlaneGrid.sample` at several moments: what does not depend on time is looked up once.

    Args:
        unit: (N, 3) float32. times: in [0, 1], numbers or () float64 tensors on the same device.
    Returns:
        (N, S * C) float32 per moment; backward also adds to `grid.grads` and marks every cell.
    """
    layout = grid.layout
    tables = [_cut(grid, time) for time in times]
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


def _cut(grid: PlaneGrid, time: float | Tensor) -> Tensor:
    """(R, C) the time planes at a moment."""
    layout = grid.layout
    if not isinstance(time, Tensor):
        time = torch.full((), time, dtype=torch.float64, device=layout.first_moment.device)
    row, share = _time_row(grid, time)
    here = layout.first_moment + row * layout.next_moment
    rows = torch.stack([here, here + layout.next_moment], -1)
    weights = torch.stack([1 - share, share]).expand(len(rows), 2).contiguous()
    return _sums(weights.requires_grad_(torch.is_grad_enabled()), rows, grid.values, grid)


def _time_row(grid: PlaneGrid, time: Tensor) -> tuple[Tensor, Tensor]:
    """`PlaneGrid.time_row` of a () float64 tensor: () int64 and () float32."""
    last = grid.time_resolution - 1
    position = ((time if grid.time_map == "full" else (time + 1) / 2) * last).clamp(0, last)
    row = position.floor().clamp(max=last - 1)
    return row.to(torch.int64), (position - row).float()


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
