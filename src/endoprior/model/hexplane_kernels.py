"""HexPlane look-up on the CPU: gather forward, two deterministic passes backward.

Shared letters: `N` Gaussians, `S` scales, `C` channels of a plane. Shared arrays (all C-contiguous, trusted):

- `unit` (N, 3) float32: position in the box, 0 at its first corner, 1 at its second; anything outside is clamped.
- `values`, `grads` (cells, C) float32: every plane of every scale, one row per cell; a plane is a block of rows.
- `space_start` (S, 3) int64: first row of planes xy, xz, yz. The cell (row r, column c) of plane `ab` is row
  `start + r * resolution[a] + c`, where c runs along a and r along b.
- `time_start` (S, 3) int64: first row of planes xt, yt, zt (rows are moments, columns run along the space axis).
- `tables` (columns, C) float32: the time planes at one moment; `table_start` (S, 3) is their first rows.
- `resolution` (S, 3) int64: cells along x, y, z of each scale, at least 2.
- `marks` (cells,) uint8: 0 never touched, `TOUCHED` touched before, `TOUCHED | FRESH` has a gradient now.

All sums run in an order that the number of threads does not change, so equal inputs give equal bits. Scratch rows have
a constant length because the compiler must know that they do not overlap before it vectorizes.
"""

from __future__ import annotations

import numpy as np
from numba import njit, prange

MAX_CHANNELS = 256
TOUCHED = 1
FRESH = 2

_FAST = {"reassoc", "contract", "nsz", "arcp", "afn"}
_CHUNK = 64  # Gaussians per task of the gathers
_LANES = 16  # channels per task of the scatters: one cache line
_ONE = np.float32(1)
_ZERO = np.float32(0)
# Column axis and row axis of the planes xy, xz, yz.
_COLUMN_AXIS = (0, 0, 1)
_ROW_AXIS = (1, 2, 2)


@njit(cache=True, fastmath=_FAST)
def _locate(unit, resolution):
    """Cell, fraction in [0, 1] and whether the gradient passes, for one coordinate with border padding.

    As in torch's `grid_sample`, the gradient stops on the border too. NaN ends up in the fraction.
    """
    top = np.float32(resolution - 1)
    position = unit * top
    if position <= _ZERO:
        return 0, _ZERO, False
    if position >= top:
        return resolution - 2, _ONE, False
    if position != position:
        return 0, position, False
    cell = min(int(position), resolution - 2)
    return cell, position - np.float32(cell), True


@njit(parallel=True, cache=True, fastmath=_FAST)
def slice_time(values, time_start, table_start, resolution, row, fraction, tables):
    """Write the time planes at one moment: `tables` = lerp of plane rows `row` and `row + 1`. One task per plane."""
    channels = values.shape[1]
    for task in prange(time_start.size):
        s, a = task // 3, task % 3
        width = resolution[s, a]
        first = time_start[s, a] + row * width
        for j in range(width):
            below, above, target = first + j, first + width + j, table_start[s, a] + j
            for c in range(channels):
                tables[target, c] = values[below, c] + fraction * (values[above, c] - values[below, c])


@njit(parallel=True, cache=True, fastmath=_FAST)
def gather(unit, values, tables, space_start, table_start, resolution, out):
    """Write `out` (N, S, C), the product of the six plane samples. One task per chunk of Gaussians."""
    num = len(unit)
    for task in prange((num + _CHUNK - 1) // _CHUNK):
        last = min(num, (task + 1) * _CHUNK)
        _gather_chunk(task * _CHUNK, last, unit, values, tables, space_start, table_start, resolution, out)


@njit(cache=True, fastmath=_FAST)
def _gather_chunk(first, last, unit, values, tables, space_start, table_start, resolution, out):
    """`gather` for Gaussians first..last-1. Loops over channels are short and many so that each one vectorizes."""
    channels = values.shape[1]
    for n in range(first, last):
        for s in range(len(resolution)):
            x, fx, _ = _locate(unit[n, 0], resolution[s, 0])
            y, fy, _ = _locate(unit[n, 1], resolution[s, 1])
            z, fz, _ = _locate(unit[n, 2], resolution[s, 2])
            for c in range(channels):
                out[n, s, c] = _ONE
            for p in range(3):
                cell, f = (x, fx) if p == 0 else ((y, fy) if p == 1 else (z, fz))
                i = table_start[s, p] + cell
                for c in range(channels):
                    out[n, s, c] *= tables[i, c] + f * (tables[i + 1, c] - tables[i, c])
                column, fu = (y, fy) if p == 2 else (x, fx)
                row, fv = (y, fy) if p == 0 else (z, fz)
                i = space_start[s, p] + row * resolution[s, _COLUMN_AXIS[p]] + column
                k = i + resolution[s, _COLUMN_AXIS[p]]
                w00, w01 = (_ONE - fv) * (_ONE - fu), (_ONE - fv) * fu
                w10, w11 = fv * (_ONE - fu), fv * fu
                for c in range(channels):
                    out[n, s, c] *= (
                        w00 * values[i, c] + w01 * values[i + 1, c] + w10 * values[k, c] + w11 * values[k + 1, c]
                    )


@njit(parallel=True, cache=True, fastmath=_FAST)
def gather_backward(s, unit, values, tables, space_start, table_start, resolution, v_out, v_samples, v_unit):
    """First backward pass, for scale `s`: what each plane sample and each coordinate owes. One task per chunk.

    Reads `v_out` (N, S, C) = dL/d(feature); writes `v_samples` (6, N, C) for planes xy, xz, yz, xt, yt, zt of this
    scale and adds to `v_unit` (N, 3).
    """
    num = len(unit)
    for task in prange((num + _CHUNK - 1) // _CHUNK):
        _gather_backward_chunk(
            task * _CHUNK, min(num, (task + 1) * _CHUNK), s, unit, values, tables,
            space_start, table_start, resolution, v_out, v_samples, v_unit,
        )  # fmt: skip


@njit(cache=True, fastmath=_FAST)
def _gather_backward_chunk(
    first, last, s, unit, values, tables, space_start, table_start, resolution, v_out, v_samples, v_unit
):
    """`gather_backward` for Gaussians first..last-1."""
    channels = values.shape[1]
    # Rows 0..5: the samples; 6: v_out times the product of the time samples; 7: ... of the space samples.
    scratch = np.empty((8, MAX_CHANNELS), dtype=np.float32)
    for n in range(first, last):
        x, fx, x_inside = _locate(unit[n, 0], resolution[s, 0])
        y, fy, y_inside = _locate(unit[n, 1], resolution[s, 1])
        z, fz, z_inside = _locate(unit[n, 2], resolution[s, 2])
        for p in range(3):
            column, fu = (y, fy) if p == 2 else (x, fx)
            row, fv = (y, fy) if p == 0 else (z, fz)
            i = space_start[s, p] + row * resolution[s, _COLUMN_AXIS[p]] + column
            k = i + resolution[s, _COLUMN_AXIS[p]]
            w00, w01 = (_ONE - fv) * (_ONE - fu), (_ONE - fv) * fu
            w10, w11 = fv * (_ONE - fu), fv * fu
            for c in range(channels):
                scratch[p, c] = (
                    w00 * values[i, c] + w01 * values[i + 1, c] + w10 * values[k, c] + w11 * values[k + 1, c]
                )
            cell, f = (x, fx) if p == 0 else ((y, fy) if p == 1 else (z, fz))
            i = table_start[s, p] + cell
            for c in range(channels):
                scratch[3 + p, c] = tables[i, c] + f * (tables[i + 1, c] - tables[i, c])
        for c in range(channels):
            scratch[6, c] = v_out[n, s, c] * (scratch[3, c] * scratch[4, c] * scratch[5, c])
            scratch[7, c] = v_out[n, s, c] * (scratch[0, c] * scratch[1, c] * scratch[2, c])
        vx, vy, vz = _ZERO, _ZERO, _ZERO
        for p in range(3):
            q, r = (p + 1) % 3, (p + 2) % 3  # the other two planes of the same kind
            for c in range(channels):
                v_samples[p, n, c] = scratch[6, c] * (scratch[q, c] * scratch[r, c])
            for c in range(channels):
                v_samples[3 + p, n, c] = scratch[7, c] * (scratch[3 + q, c] * scratch[3 + r, c])
            column, fu = (y, fy) if p == 2 else (x, fx)
            row, fv = (y, fy) if p == 0 else (z, fz)
            i = space_start[s, p] + row * resolution[s, _COLUMN_AXIS[p]] + column
            k = i + resolution[s, _COLUMN_AXIS[p]]
            v_column, v_row, v_cell = _ZERO, _ZERO, _ZERO
            for c in range(channels):
                top, bottom = values[i + 1, c] - values[i, c], values[k + 1, c] - values[k, c]
                left, right = values[k, c] - values[i, c], values[k + 1, c] - values[i + 1, c]
                v_column += v_samples[p, n, c] * (top + fv * (bottom - top))
                v_row += v_samples[p, n, c] * (left + fu * (right - left))
            i = table_start[s, p] + (x if p == 0 else (y if p == 1 else z))
            for c in range(channels):
                v_cell += v_samples[3 + p, n, c] * (tables[i + 1, c] - tables[i, c])
            if p == 0:  # planes xy and xt
                vx += v_column + v_cell
                vy += v_row
            elif p == 1:  # xz and yt
                vx += v_column
                vz += v_row
                vy += v_cell
            else:  # yz and zt
                vy += v_column
                vz += v_row + v_cell
        if x_inside:
            v_unit[n, 0] += vx * np.float32(resolution[s, 0] - 1)
        if y_inside:
            v_unit[n, 1] += vy * np.float32(resolution[s, 1] - 1)
        if z_inside:
            v_unit[n, 2] += vz * np.float32(resolution[s, 2] - 1)


@njit(parallel=True, cache=True, fastmath=_FAST)
def scatter(s, unit, v_samples, space_start, table_start, resolution, grads, v_tables, marks, table_marks):
    """Second backward pass, for scale `s`: add `v_samples` to the cells they came from.

    One task per (block of channels, plane), each walking all Gaussians in order; tasks share no memory. Adds to
    `grads` and `v_tables` (columns, C); the tasks of the first block set `marks` and `table_marks` (columns,).
    """
    for task in prange(6 * ((grads.shape[1] + _LANES - 1) // _LANES)):
        p, block = task % 6, task // 6
        if p < 3:
            _scatter_space(p, block, s, unit, v_samples, space_start, resolution, grads, marks)
        else:
            _scatter_time(p - 3, block, s, unit, v_samples, table_start, resolution, v_tables, table_marks)


@njit(cache=True, fastmath=_FAST)
def _scatter_space(p, block, s, unit, v_samples, space_start, resolution, grads, marks):
    """`scatter` for one block of channels of one of the planes xy, xz, yz."""
    lanes = min(_LANES, grads.shape[1] - block * _LANES)
    offset = np.uintp(block * _LANES)  # unsigned: spares the compiler the check for negative indices
    width, height = resolution[s, _COLUMN_AXIS[p]], resolution[s, _ROW_AXIS[p]]
    for n in range(len(unit)):
        column, fu, _ = _locate(unit[n, _COLUMN_AXIS[p]], width)
        row, fv, _ = _locate(unit[n, _ROW_AXIS[p]], height)
        i = space_start[s, p] + row * width + column
        k = i + width
        w00, w01 = (_ONE - fv) * (_ONE - fu), (_ONE - fv) * fu
        w10, w11 = fv * (_ONE - fu), fv * fu
        for lane in range(lanes):
            c = offset + np.uintp(lane)
            grads[i, c] += w00 * v_samples[p, n, c]
            grads[i + 1, c] += w01 * v_samples[p, n, c]
        for lane in range(lanes):
            c = offset + np.uintp(lane)
            grads[k, c] += w10 * v_samples[p, n, c]
            grads[k + 1, c] += w11 * v_samples[p, n, c]
        if block == 0:
            marks[i] = marks[i + 1] = marks[k] = marks[k + 1] = TOUCHED | FRESH


@njit(cache=True, fastmath=_FAST)
def _scatter_time(a, block, s, unit, v_samples, table_start, resolution, v_tables, table_marks):
    """`scatter` for one block of channels of the time plane of axis `a`."""
    lanes = min(_LANES, v_tables.shape[1] - block * _LANES)
    offset = np.uintp(block * _LANES)
    for n in range(len(unit)):
        cell, f, _ = _locate(unit[n, a], resolution[s, a])
        i = table_start[s, a] + cell
        for lane in range(lanes):
            c = offset + np.uintp(lane)
            v_tables[i, c] += (_ONE - f) * v_samples[3 + a, n, c]
            v_tables[i + 1, c] += f * v_samples[3 + a, n, c]
        if block == 0:
            table_marks[i] = table_marks[i + 1] = 1


@njit(parallel=True, cache=True, fastmath=_FAST)
def slice_time_backward(v_tables, table_marks, time_start, table_start, resolution, row, fraction, grads, marks):
    """Add `v_tables` to rows `row` and `row + 1` of the time planes, where marked. One task per plane."""
    channels = grads.shape[1]
    for task in prange(time_start.size):
        s, a = task // 3, task % 3
        width = resolution[s, a]
        first = time_start[s, a] + row * width
        for j in range(width):
            source, below, above = table_start[s, a] + j, first + j, first + width + j
            if table_marks[source]:
                for c in range(channels):
                    grads[below, c] += (_ONE - fraction) * v_tables[source, c]
                    grads[above, c] += fraction * v_tables[source, c]
                marks[below] = marks[above] = TOUCHED | FRESH
