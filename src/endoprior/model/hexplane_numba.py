"""A linear layer on HexPlane features by Numba kernels, and its gradient: the trunk of the deformation field on a CPU.

Features are many times wider than what the layer makes of them, so they exist only for a chunk of positions at a time.
Letters: `N` positions, `n` those of one chunk, `M` times, `F` features, `W` outputs of the layer.
"""

from __future__ import annotations

import math
from functools import reduce
from typing import Any

import numba
import numpy as np
import torch
from torch import Tensor
from torch.autograd.function import once_differentiable

from ..compute.simd import LANES
from ..core.checks import check_shape
from . import hexplane_kernels as kernels
from .hexplane import PlaneGrid

CHUNK = 2048
"""Positions whose features exist at a time under a linear layer: few enough for the cache."""


def hexplane_linear(
    grid: PlaneGrid, unit: Tensor, times: tuple[float, ...], weight: Tensor, bias: Tensor
) -> tuple[Tensor, ...]:
    """See `hexplane.hexplane_linear`."""
    check_shape(f"unit:N,3 weight:W,{grid.num_features} bias:W", unit=unit, weight=weight, bias=bias)
    return _Linear.apply(unit, weight, bias, times, grid)


class _Lookup:
    """The planes at M times: the time planes are interpolated once, then positions are looked up chunk by chunk."""

    def __init__(self, grid: PlaneGrid, times: tuple[float, ...]) -> None:
        rows, fractions = zip(*map(grid.time_row, times), strict=True)
        self.grid, self.num_times = grid, len(times)
        self._time_rows = (np.array(rows, dtype=np.int64), np.array(fractions, dtype=np.float32))
        self.values = grid.values.view(-1).numpy()
        self.tables = torch.empty(int(grid.resolution.sum()) * self.num_times * grid.channels).numpy()
        kernels.slice_time(
            self.values,
            grid.channels,
            grid.time_start,
            grid.table_start,
            grid.resolution,
            *self._time_rows,
            self.tables,
        )
        self._planes = (self.values, grid.channels, self.tables, self.num_times)
        self._layout = (grid.space_start, grid.table_start, grid.resolution)

    def empty_features(self, num: int) -> Tensor:
        """Uninitialized features (M, num, F)."""
        return torch.empty(self.num_times, num, self.grid.num_features)

    def gather(self, unit: Tensor, features: Tensor) -> None:
        """Fill `features` (M, n, F) with those of positions `unit` (n, 3)."""
        kernels.gather(unit.numpy(), *self._planes, self._layout, features.view(-1).numpy())

    def start_backward(self) -> None:
        """Start with a zero gradient of the time planes."""
        self.v_tables = torch.zeros(self.tables.size).numpy()
        self.table_marks = np.zeros(int(self.grid.resolution.sum()), dtype=np.uint8)

    def scatter(self, unit: Tensor, features: Tensor, v_unit: Tensor) -> None:
        """Propagate the gradient of the features to positions and planes, and compute the features again.

        Args:
            unit: (n, 3).
            features: (M, n, F) dL/d(features) on entry, the features themselves on return.
            v_unit: (n, 3) takes dL/d(unit). The gradient of the planes is added to `grid.grads`.
        """
        grid = self.grid
        blocks = math.ceil(grid.channels / LANES)
        tasks_per_scale = min(blocks, math.ceil(2 * numba.get_num_threads() / grid.num_scales))
        parts = np.empty((grid.num_scales, blocks, len(unit), 3), dtype=np.float32)
        kernels.scatter(
            unit.numpy(), *self._planes, self._layout, features.view(-1).numpy(),
            grid.grads.view(-1).numpy(), self.v_tables, grid.marks.numpy(), self.table_marks, parts,
            math.ceil(blocks / tasks_per_scale) * LANES,
        )  # fmt: skip
        np.sum(parts, axis=(0, 1), out=v_unit.numpy())

    def finish_backward(self) -> None:
        """Add the gradient of the time planes to `grid.grads`."""
        grid = self.grid
        kernels.slice_time_backward(
            self.v_tables, grid.channels, self.table_marks, grid.time_start, grid.table_start, grid.resolution,
            *self._time_rows, grid.grads.view(-1).numpy(), grid.marks.numpy(),
        )  # fmt: skip


class _Linear(torch.autograd.Function):
    """Features times a matrix, at M times; features are computed chunk by chunk in both passes."""

    @staticmethod
    def forward(
        ctx: Any, unit: Tensor, weight: Tensor, bias: Tensor, times: tuple[float, ...], grid: PlaneGrid
    ) -> tuple[Tensor, ...]:
        """`unit` (N, 3), `weight` (W, F), `bias` (W,), trusted; a tensor (N, W) per time."""
        ctx.lookup, unit = _Lookup(grid, times), unit.detach().contiguous()
        ctx.save_for_backward(unit, weight)
        out = tuple(torch.empty(len(unit), len(weight)) for _ in times)
        for rows in _chunks(len(unit)):
            features = ctx.lookup.empty_features(len(unit[rows]))
            ctx.lookup.gather(unit[rows], features)
            made = torch.addmm(bias, features.flatten(0, 1), weight.T)
            for target, part in zip(out, made.chunk(len(times)), strict=True):
                target[rows] = part
        return out

    @staticmethod
    @once_differentiable
    def backward(ctx: Any, *v_out: Tensor) -> tuple[Tensor | None, ...]:
        """Gradients of positions, weight and bias; that of the planes goes to their buffer."""
        unit, weight = ctx.saved_tensors
        v_unit, v_weight = torch.empty_like(unit), torch.zeros_like(weight)
        ctx.lookup.start_backward()
        for rows in _chunks(len(unit)):
            features = ctx.lookup.empty_features(len(unit[rows]))
            v_made = torch.cat([v_time[rows] for v_time in v_out])
            torch.mm(v_made, weight, out=features.flatten(0, 1))
            ctx.lookup.scatter(unit[rows], features, v_unit[rows])
            v_weight.addmm_(v_made.T, features.flatten(0, 1))
        ctx.lookup.finish_backward()
        v_bias = reduce(torch.add, (v_time.sum(0) for v_time in v_out))
        return v_unit, v_weight, v_bias, None, None


def _chunks(num: int) -> list[slice]:
    return [slice(first, first + CHUNK) for first in range(0, num, CHUNK)]
