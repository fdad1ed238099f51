"""HexPlane features by Numba kernels on the CPU, under a linear layer: the trunk of the deformation field.

Features are many times wider than what the layer makes of them, so they exist only for a chunk of positions at a time.
The kernels look up forward, differentiate and scatter backward, at several times at once.

Letters: `N` positions, `n` those of one chunk, `M` times, `S` scales, `C` channels of a plane, `F` features, `W`
outputs of the layer. Samples of the planes xy, xz, yz do not depend on time, so each is read once, and the gradients of
all times are added up before they are written. Arrays that kernels share (all C-contiguous, trusted; "flat" ones are
one-dimensional views of the shape that is given):

- `unit` (N, 3) float32: position in the box, 0 at its first corner, 1 at its second; anything outside is clamped.
- `values`, `grads` (cells, C) float32, flat: every plane of every scale; a plane is a block of cells.
- `space_start` (S, 3) int64: first cell of planes xy, xz, yz. The cell (row r, column c) of plane `ab` is
  `start + r * resolution[a] + c`, where c runs along a and r along b.
- `time_start` (S, 3) int64: first cell of planes xt, yt, zt (rows are time steps, columns run along the space axis).
- `tables`, `v_tables` (columns, M, C), flat: the time planes at these times; `table_start` (S, 3): first columns.
- `features` (M, N, S, C) float32, flat.
- `resolution` (S, 3) int64: cells along x, y, z of each scale, at least 2. `layout` is (space_start, table_start,
  resolution).
- `marks` (cells,) uint8: 0 never touched, `TOUCHED` touched before, `TOUCHED | FRESH` has a gradient now.

Work is done in vectors of `LANES` channels. `lanes` is None for a whole vector and a number for the last one of planes
whose channels are no multiple of it; Numba compiles a version for each. `values` and `grads` should start on a cache
line: a vector that straddles two costs twice, and shares one with another task. Memory is the bottleneck:
positions that lie near each other should follow each other.

All sums run in an order that the number of threads does not change, so equal inputs give equal bits.
"""

# pyright: reportCallIssue=false, reportGeneralTypeIssues=false
from __future__ import annotations

import math
from functools import reduce
from typing import Any

import numba
import numpy as np
import torch
from numba import njit, prange
from torch import Tensor
from torch.autograd.function import once_differentiable

from ..compute.parallel_kernels import parallel_njit
from ..compute.simd import LANES, broadcast, fma, load_some, prefetch, store_some, total
from ..core.checks import check_shape
from .hexplane import FRESH, TOUCHED, PlaneGrid

CHUNK = 2048
"""Positions whose features exist at a time under a linear layer: few enough for the cache."""
_CHUNK = 64  # positions per task of the gather
_AHEAD = 4  # positions between asking for cells and using them
_ONE = np.float32(1)
_ZERO = np.float32(0)


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
        tables = (grid.time_start, grid.table_start, grid.resolution, *self._time_rows, self.tables)
        slice_time(self.values, grid.channels, *tables)
        self._planes = (self.values, grid.channels, self.tables, self.num_times)
        self._layout = (grid.space_start, grid.table_start, grid.resolution)

    def empty_features(self, num: int) -> Tensor:
        """Uninitialized features (M, num, F)."""
        return torch.empty(self.num_times, num, self.grid.num_features)

    def gather(self, unit: Tensor, features: Tensor) -> None:
        """Fill `features` (M, n, F) with those of positions `unit` (n, 3)."""
        gather(unit.numpy(), *self._planes, self._layout, features.view(-1).numpy())

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
        scatter(
            unit.numpy(), *self._planes, self._layout, features.view(-1).numpy(),
            grid.grads.view(-1).numpy(), self.v_tables, grid.marks.numpy(), self.table_marks, parts,
            math.ceil(blocks / tasks_per_scale) * LANES,
        )  # fmt: skip
        np.sum(parts, axis=(0, 1), out=v_unit.numpy())

    def finish_backward(self) -> None:
        """Add the gradient of the time planes to `grid.grads`."""
        grid = self.grid
        slice_time_backward(
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


@njit(inline="always")
def _locate(unit, resolution):
    # Cell, fraction in [0, 1] and slope (cells per unit) of one coordinate with border padding. As in torch's
    # `grid_sample`, the gradient stops on the border too. NaN ends up in the fraction.
    top = np.float32(resolution - 1)
    position = unit * top
    if position <= _ZERO:
        cell, fraction, slope = 0, _ZERO, _ZERO
    elif position >= top:
        cell, fraction, slope = resolution - 2, _ONE, _ZERO
    elif position != position:
        cell, fraction, slope = 0, position, _ZERO
    else:
        cell = min(int(position), resolution - 2)
        fraction, slope = position - np.float32(cell), top
    return cell, fraction, slope


@njit(inline="always")
def _find(unit, n, s, layout):
    # Where Gaussian n lies at scale s: first cells in xy, xz, yz, first columns in the tables, fractions, slopes.
    space_start, table_start, resolution = layout
    x, fx, slope_x = _locate(unit[n, 0], resolution[s, 0])
    y, fy, slope_y = _locate(unit[n, 1], resolution[s, 1])
    z, fz, slope_z = _locate(unit[n, 2], resolution[s, 2])
    width, depth = resolution[s, 0], resolution[s, 1]
    cells = (space_start[s, 0] + y * width + x, space_start[s, 1] + z * width + x, space_start[s, 2] + z * depth + y)
    columns = (table_start[s, 0] + x, table_start[s, 1] + y, table_start[s, 2] + z)
    return cells, columns, (broadcast(fx), broadcast(fy), broadcast(fz)), (slope_x, slope_y, slope_z)


@njit(inline="always")
def _bilinear(values, near, far, step, u, v, lanes):
    # Sample of a plane and its derivatives along columns and rows, in cells. Row `near` and the next one, `far`, both
    # from the left column on; `step` elements to the right one.
    a, b = load_some(values, near, lanes), load_some(values, near + step, lanes)
    c, d = load_some(values, far, lanes), load_some(values, far + step, lanes)
    down_left, down_right = c - a, d - b
    left, right = fma(v, down_left, a), fma(v, down_right, b)
    across = right - left
    return fma(u, across, left), across, fma(u, down_right - down_left, down_left)


@njit(inline="always")
def _add_bilinear(grads, near, far, step, u, v, v_sample, lanes):
    # Adds v_sample to the four cells of a sample. All are read before any is written: rows lie a power of two apart,
    # and a load soon after a store with the same low address bits would wait for it.
    below = v * v_sample
    above = v_sample - below
    above_right, below_right = u * above, u * below
    a, b = load_some(grads, near, lanes) + (above - above_right), load_some(grads, near + step, lanes) + above_right
    c, d = load_some(grads, far, lanes) + (below - below_right), load_some(grads, far + step, lanes) + below_right
    store_some(grads, near, a, lanes)
    store_some(grads, near + step, b, lanes)
    store_some(grads, far, c, lanes)
    store_some(grads, far + step, d, lanes)


@njit(inline="always")
def _linear(tables, at, step, u, lanes):
    # Sample of a time plane and its derivative, in cells.
    left = load_some(tables, at, lanes)
    across = load_some(tables, at + step, lanes) - left
    return fma(u, across, left), across


@njit(inline="always")
def _add_linear(v_tables, at, step, u, v_sample, lanes):
    # Adds v_sample to the two columns of a sample.
    on_right = u * v_sample
    a = load_some(v_tables, at, lanes) + (v_sample - on_right)
    b = load_some(v_tables, at + step, lanes) + on_right
    store_some(v_tables, at, a, lanes)
    store_some(v_tables, at + step, b, lanes)


@njit(inline="always")
def _expect(array, cells, c, steps):
    # Asks for the cells of all three samples, at channel `c`.
    step, down_x, down_y, _ = steps
    for cell, down in ((cells[0], down_x), (cells[1], down_x), (cells[2], down_y)):
        place = cell * step + c
        prefetch(array, place)
        prefetch(array, place + step)
        prefetch(array, place + down)
        prefetch(array, place + down + step)


@parallel_njit(error_model="numpy")
def slice_time(values, channels, time_start, table_start, resolution, rows, fractions, tables):
    # Interpolates the time planes at the given times: tables = lerp of plane rows `rows[m]` and `rows[m] + 1`. One task
    # per plane.
    num_times = len(rows)
    for task in prange(time_start.size):
        s, a = task // 3, task % 3
        width = resolution[s, a]
        for j in range(width):
            for m in range(num_times):
                below = (time_start[s, a] + rows[m] * width + j) * channels
                above, target = below + width * channels, ((table_start[s, a] + j) * num_times + m) * channels
                for c in range(channels):
                    tables[target + c] = values[below + c] + fractions[m] * (values[above + c] - values[below + c])


@parallel_njit(error_model="numpy")
def gather(unit, values, channels, tables, num_times, layout, features):
    # Writes `features`, the products of the six plane samples. One task per chunk of Gaussians.
    num = len(unit)
    for task in prange((num + _CHUNK - 1) // _CHUNK):
        last = min(num, (task + 1) * _CHUNK)
        _gather_chunk(task * _CHUNK, last, unit, values, channels, tables, num_times, layout, features)


@njit(cache=True, error_model="numpy")
def _gather_chunk(first, last, unit, values, channels, tables, num_times, layout, features):
    # `gather` for Gaussians first..last-1.
    resolution = layout[2]
    num, num_scales, whole = len(unit), len(resolution), channels // LANES * LANES
    for n in range(first, last):
        for s in range(num_scales):
            cells, columns, fractions, _ = _find(unit, n, s, layout)
            steps = (channels, resolution[s, 0] * channels, resolution[s, 1] * channels, num_times * channels)
            ahead, _, _, _ = _find(unit, min(n + _AHEAD, num - 1), s, layout)
            place, stride = (n * num_scales + s) * channels, num * num_scales * channels
            for c in range(0, whole, LANES):
                _expect(values, ahead, c, steps)
                _gather_block(
                    c, None,
                    values, tables, num_times, cells, columns, fractions, steps, features, place, stride,
                )  # fmt: skip
            if whole < channels:
                _gather_block(
                    whole, channels - whole,
                    values, tables, num_times, cells, columns, fractions, steps, features, place, stride,
                )  # fmt: skip


@njit(inline="always")
def _gather_block(c, lanes, values, tables, num_times, cells, columns, fractions, steps, features, place, stride):
    # `gather` for one Gaussian, one scale and the channels from `c` on. `steps`: elements between cells of a row,
    # between rows of planes over x and over y, between columns of the tables. Time m writes to `place + m * stride`.
    step, down_x, down_y, step_t = steps
    ux, uy, uz = fractions
    xy, xz, yz = cells[0] * step + c, cells[1] * step + c, cells[2] * step + c
    sample_xy, _, _ = _bilinear(values, xy, xy + down_x, step, ux, uy, lanes)
    sample_xz, _, _ = _bilinear(values, xz, xz + down_x, step, ux, uz, lanes)
    sample_yz, _, _ = _bilinear(values, yz, yz + down_y, step, uy, uz, lanes)
    space = sample_xy * (sample_xz * sample_yz)
    for m in range(num_times):
        at = m * step + c
        sample_xt, _ = _linear(tables, columns[0] * step_t + at, step_t, ux, lanes)
        sample_yt, _ = _linear(tables, columns[1] * step_t + at, step_t, uy, lanes)
        sample_zt, _ = _linear(tables, columns[2] * step_t + at, step_t, uz, lanes)
        in_time = sample_xt * (sample_yt * sample_zt)
        store_some(features, m * stride + place + c, space * in_time, lanes)


@parallel_njit(error_model="numpy")
def scatter(
    unit, values, channels, tables, num_times, layout, features, grads, v_tables, marks, table_marks, v_unit, share
):
    # The backward pass. `features` holds dL/d(features) on entry and the features themselves on return. Adds to
    # `grads` and `v_tables`, marks cells and columns, and writes v_unit (S, blocks, N, 3), where a block is a vector of
    # channels; its sum over scales and blocks is dL/d(unit).
    # One task per (scale, `share` channels, a multiple of LANES), each walking all Gaussians in order; tasks share no
    # memory. A large share reads and writes a cell in one piece. Fine scales cost more, so they alternate with coarse.
    num_scales = len(layout[2])
    for task in prange((channels + share - 1) // share * num_scales):
        turn, first = task % num_scales, task // num_scales * share
        s = turn // 2 if turn % 2 else num_scales - 1 - turn // 2
        _scatter_share(
            s, first, min(channels, first + share), unit, values, channels, tables, num_times, layout,
            features, grads, v_tables, marks, table_marks, v_unit[s],
        )  # fmt: skip


@njit(cache=True, error_model="numpy")
def _scatter_share(
    s, first, last, unit, values, channels, tables, num_times, layout,
    features, grads, v_tables, marks, table_marks, v_unit,
):  # fmt: skip
    # `scatter` for one scale and channels first..last-1.
    resolution = layout[2]
    num, num_scales, whole = len(unit), len(resolution), first + (last - first) // LANES * LANES
    width, depth = resolution[s, 0], resolution[s, 1]
    steps = (channels, width * channels, depth * channels, num_times * channels)
    for n in range(num):
        cells, columns, fractions, slopes = _find(unit, n, s, layout)
        ahead, _, _, _ = _find(unit, min(n + _AHEAD, num - 1), s, layout)
        place, stride = (n * num_scales + s) * channels, num * num_scales * channels
        for c in range(first, whole, LANES):
            _expect(values, ahead, c, steps)
            _expect(grads, ahead, c, steps)
            _scatter_block(
                c, None, values, tables, num_times, cells, columns, fractions, slopes, steps,
                features, place, stride, grads, v_tables, v_unit, n,
            )  # fmt: skip
        if whole < last:
            _scatter_block(
                whole, last - whole, values, tables, num_times, cells, columns, fractions, slopes, steps,
                features, place, stride, grads, v_tables, v_unit, n,
            )  # fmt: skip
        if first == 0:
            _mark(marks, cells[0], width)
            _mark(marks, cells[1], width)
            _mark(marks, cells[2], depth)
            for column in columns:
                table_marks[column] = table_marks[column + 1] = 1


@njit(inline="always")
def _scatter_block(
    c, lanes, values, tables, num_times, cells, columns, fractions, slopes, steps,
    features, place, stride, grads, v_tables, v_unit, n,
):  # fmt: skip
    # `scatter` for one Gaussian, one scale and the channels from `c` on; arguments as in `_gather_block`.
    # `sample_ab` is that of plane ab, `ab_a` its slope along a.
    step, down_x, down_y, step_t = steps
    ux, uy, uz = fractions
    xy, xz, yz = cells[0] * step + c, cells[1] * step + c, cells[2] * step + c
    sample_xy, xy_x, xy_y = _bilinear(values, xy, xy + down_x, step, ux, uy, lanes)
    sample_xz, xz_x, xz_z = _bilinear(values, xz, xz + down_x, step, ux, uz, lanes)
    sample_yz, yz_y, yz_z = _bilinear(values, yz, yz + down_y, step, uy, uz, lanes)
    of_z = sample_xz * sample_yz
    space = sample_xy * of_z
    v_x = v_y = v_z = v_space = broadcast(_ZERO)
    for m in range(num_times):
        at = m * step + c
        xt, yt, zt = columns[0] * step_t + at, columns[1] * step_t + at, columns[2] * step_t + at
        sample_xt, xt_x = _linear(tables, xt, step_t, ux, lanes)
        sample_yt, yt_y = _linear(tables, yt, step_t, uy, lanes)
        sample_zt, zt_z = _linear(tables, zt, step_t, uz, lanes)
        of_yz = sample_yt * sample_zt
        in_time = sample_xt * of_yz
        v_feature = load_some(features, m * stride + place + c, lanes)
        store_some(features, m * stride + place + c, space * in_time, lanes)
        v_space = fma(v_feature, in_time, v_space)
        v_in_time = v_feature * space
        v_xt, v_rest = v_in_time * of_yz, v_in_time * sample_xt
        v_yt, v_zt = v_rest * sample_zt, v_rest * sample_yt
        v_x, v_y, v_z = fma(v_xt, xt_x, v_x), fma(v_yt, yt_y, v_y), fma(v_zt, zt_z, v_z)
        _add_linear(v_tables, xt, step_t, ux, v_xt, lanes)
        _add_linear(v_tables, yt, step_t, uy, v_yt, lanes)
        _add_linear(v_tables, zt, step_t, uz, v_zt, lanes)
    v_xy, v_rest = v_space * of_z, v_space * sample_xy
    v_xz, v_yz = v_rest * sample_yz, v_rest * sample_xz
    _add_bilinear(grads, xy, xy + down_x, step, ux, uy, v_xy, lanes)
    _add_bilinear(grads, xz, xz + down_x, step, ux, uz, v_xz, lanes)
    _add_bilinear(grads, yz, yz + down_y, step, uy, uz, v_yz, lanes)
    v_unit[c // LANES, n, 0] = total(fma(v_xy, xy_x, fma(v_xz, xz_x, v_x))) * slopes[0]
    v_unit[c // LANES, n, 1] = total(fma(v_xy, xy_y, fma(v_yz, yz_y, v_y))) * slopes[1]
    v_unit[c // LANES, n, 2] = total(fma(v_xz, xz_z, fma(v_yz, yz_z, v_z))) * slopes[2]


@njit(inline="always")
def _mark(marks, cell, width):
    # The four cells of a sample have a gradient.
    marks[cell] = marks[cell + 1] = marks[cell + width] = marks[cell + width + 1] = TOUCHED | FRESH


@parallel_njit(error_model="numpy")
def slice_time_backward(
    v_tables, channels, table_marks, time_start, table_start, resolution, rows, fractions, grads, marks
):
    # Adds `v_tables` to rows `rows[m]` and `rows[m] + 1` of the time planes, where marked. One task per plane.
    num_times = len(rows)
    for task in prange(time_start.size):
        s, a = task // 3, task % 3
        width = resolution[s, a]
        for m in range(num_times):
            for j in range(width):
                column, cell = table_start[s, a] + j, time_start[s, a] + rows[m] * width + j
                if table_marks[column]:
                    source = (column * num_times + m) * channels
                    below, above = cell * channels, (cell + width) * channels
                    for c in range(channels):
                        grads[below + c] += (_ONE - fractions[m]) * v_tables[source + c]
                        grads[above + c] += fractions[m] * v_tables[source + c]
                    marks[cell] = marks[cell + width] = TOUCHED | FRESH
