"""HexPlane: features of (x, y, z, t) as products of six planes, at several spatial scales.

The planes hold tens of millions of numbers of which one step reads a small part, so they live outside the autograd
graph: `hexplane_linear` is differentiable in the position, and its backward pass adds the gradient of the planes to the
persistent buffer `PlaneGrid.grads`, which the optimizer consumes. Here it is in PyTorch, for any device;
`hexplane_numba.py` computes the same.

Sampling is that of the published field: bilinear, corners aligned, border padding; product over the planes, features
of the scales concatenated (EndoGaussian; Cao and Johnson, "HexPlane", CVPR 2023). The time planes are interpolated at
each time first; a feature is then a product of three bilinear and three linear look-ups. Each look-up is a weighted sum
of a few rows of one matrix, whose gradient is added to the rows of `PlaneGrid.grads`: autograd would allocate a
gradient of all planes, hundreds of megabytes, for each of the twenty-four.

Letters: `N` positions, `S` scales, `C` channels, `R` rows of the interpolated time planes.
"""

from __future__ import annotations

import math
from copy import copy
from functools import cached_property
from typing import Any, NamedTuple

import numpy as np
import torch
from torch import Tensor
from torch.autograd.function import once_differentiable
from torch.nn.functional import embedding_bag, linear

from ..core.checks import check_shape
from ..core.config_deformation import HexPlaneConfig

PLANE_NAMES = ("xy", "xz", "yz", "xt", "yt", "zt")
TOUCHED, FRESH = 1, 2
"""Bits of `PlaneGrid.marks`: the cell ever had a gradient; it has one now."""
CACHE_LINE = 64
"""Bytes."""


def mapped_zeros(*shape: int) -> Tensor:
    """float32 zeros that begin on a cache line and take memory only where written: NumPy maps, torch would fill."""
    size = math.prod(shape)
    buffer = np.zeros(size + CACHE_LINE // 4, dtype=np.float32)
    start = -buffer.ctypes.data % CACHE_LINE // 4
    return torch.from_numpy(buffer[start : start + size]).view(shape)


def plane_shapes(cfg: HexPlaneConfig) -> list[dict[str, tuple[int, int]]]:
    """Rows and columns of each plane of each scale, by name; nothing is allocated.

    Columns run along the first letter of a name, rows along the second.
    """
    scales = [
        {**dict(zip("xyz", (r * m for r in cfg.resolution), strict=True)), "t": cfg.time_resolution}
        for m in cfg.multires
    ]
    return [{name: (cells[name[1]], cells[name[0]]) for name in PLANE_NAMES} for cells in scales]


class Layout(NamedTuple):
    """Where the planes lie in `PlaneGrid.values`; `S` scales, `R` columns of all time planes."""

    resolution: Tensor  # (S, 3) float32 cells along x, y, z
    space_start: Tensor  # (S, 3) first cell of the planes xy, xz, yz
    space_width: Tensor  # (S, 3) cells from one row of these planes to the next
    table_start: Tensor  # (S, 3) first column of the planes xt, yt, zt
    time_first: Tensor  # (R,) cell that holds each column of the time planes in their first row
    time_step: Tensor  # (R,) cells from one row of that column to the next


class PlaneGrid:
    """Plane values, their gradients and which cells were ever used.

    `values` (cells, C) float32 holds all planes; `plane(scale, name)` views one of them. `grads` has the same shape
    and its pages take memory only once written. `marks` (cells,) uint8 says which cells a gradient ever reached.
    """

    def __init__(self, cfg: HexPlaneConfig) -> None:
        """Allocate planes filled with 1. `initialize` draws the starting values of the space planes."""
        space = np.array([[r * m for r in cfg.resolution] for m in cfg.multires], dtype=np.int64).reshape(-1, 3)
        self.resolution = space
        self.time_resolution = cfg.time_resolution
        self.channels = cfg.channels
        self._shapes = [[shapes[name] for name in PLANE_NAMES] for shapes in plane_shapes(cfg)]
        sizes = np.array([[rows * columns for rows, columns in scale] for scale in self._shapes], dtype=np.int64)
        starts = (np.cumsum(sizes) - sizes.ravel()).reshape(-1, 6)
        self.space_start, self.time_start = starts[:, :3].copy(), starts[:, 3:].copy()
        self._starts = starts
        self.table_start = (np.cumsum(space) - space.ravel()).reshape(-1, 3)
        self.num_cells = int(sizes.sum())
        self.values = torch.ones(self.num_cells, self.channels)
        self.grads = self.zeros()
        self.marks = torch.zeros(self.num_cells, dtype=torch.uint8)

    @property
    def num_scales(self) -> int:
        """S."""
        return len(self.resolution)

    @property
    def num_features(self) -> int:
        """Width of a feature, S * C."""
        return self.num_scales * self.channels

    def plane(self, scale: int, name: str, of: Tensor | None = None) -> Tensor:
        """View (rows, columns, C) of one plane of `values`, or of another tensor with one row per cell.

        Columns run along the first letter of `name`, rows along the second.
        """
        index = PLANE_NAMES.index(name)
        rows, columns = self._shapes[scale][index]
        start = int(self._starts[scale, index])
        source = self.values if of is None else of
        return source[start : start + rows * columns].view(rows, columns, -1)

    def initialize(self, generator: torch.Generator) -> None:
        """Draw the space planes from U[0.1, 0.5] and set the time planes to 1 (EndoGaussian)."""
        for scale in range(self.num_scales):
            for name in PLANE_NAMES[:3]:
                self.plane(scale, name).uniform_(0.1, 0.5, generator=generator)
            for name in PLANE_NAMES[3:]:
                self.plane(scale, name).fill_(1)

    def to(self, device: torch.device) -> PlaneGrid:
        """A copy on a device, without gradients."""
        moved = self._copy(self.values.detach().to(device, torch.float32))
        moved.marks = self.marks.to(device)
        moved.grads = moved.zeros()
        return moved

    def to_fp16(self, device: torch.device) -> PlaneGrid:
        """A copy in half precision on a device, for look-ups only: it has no gradients and cannot be trained."""
        return self._copy(self.values.detach().to(device, torch.float16))

    def _copy(self, values: Tensor) -> PlaneGrid:
        moved = copy(self)
        moved.values, moved.grads, moved.marks = values, values[:0], self.marks[:0]
        moved.__dict__.pop("layout", None)
        return moved

    @cached_property
    def layout(self) -> Layout:
        """Where the planes lie, as tensors on the device of `values`."""
        size = torch.from_numpy(self.resolution)
        first, step = [], []
        for starts, cells in zip(self.time_start.tolist(), self.resolution.tolist(), strict=True):
            for start, count in zip(starts, cells, strict=True):
                first.append(start + torch.arange(count))
                step.append(torch.full((count,), count))
        tables = (
            size.float(),
            torch.from_numpy(self.space_start),
            torch.stack([size[:, 0], size[:, 0], size[:, 1]], 1),
            torch.from_numpy(self.table_start),
            torch.cat(first),
            torch.cat(step),
        )
        return Layout(*(table.to(self.values.device) for table in tables))

    def zeros(self) -> Tensor:
        """Zeros like `values`, where they are; on the CPU they take memory only once written."""
        on_cpu = self.values.device.type == "cpu"
        return mapped_zeros(self.num_cells, self.channels) if on_cpu else torch.zeros_like(self.values)

    def clear_grads(self) -> None:
        """Forget gradients that no optimizer step consumed; cells stay marked as touched."""
        fresh = (self.marks & FRESH).nonzero()[:, 0]
        self.grads[fresh] = 0
        self.marks &= TOUCHED

    def time_row(self, time: float) -> tuple[int, np.float32]:
        """Row r and fraction f of the time planes at `time`: the sample is (1 - f) * row r + f * row r + 1.

        As published, t in [0, 1] itself is the coordinate in [-1, 1], so that half of the planes is used.
        """
        last = self.time_resolution - 1
        position = (time + 1) / 2 * last
        position = min(max(position, 0.0), float(last))
        row = min(int(position), last - 1)
        return row, np.float32(position - row)


def hexplane_linear(
    grid: PlaneGrid, unit: Tensor, times: tuple[float, ...], weight: Tensor, bias: Tensor
) -> tuple[Tensor, ...]:
    """A linear layer on the features at one or more times; backward also adds to `grid.grads`.

    Args:
        unit: (N, 3) float32 positions, 0..1 from the first to the second corner of the box; clamped outside.
        times: M of them in [0, 1]. weight: (W, S * C). bias: (W,).
    Returns:
        (N, W) float32 per time.
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
