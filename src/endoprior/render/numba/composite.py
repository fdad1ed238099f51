# pyright: reportCallIssue=false, reportGeneralTypeIssues=false
"""Front-to-back compositing of the tiles, forward and backward.

One task per worker, over every `workers`-th tile of the list sorted by cost, so that the workers finish together. A
tile keeps its pixels in one flat array `state[strip, row, plane, lane]`, with planes of LANES pixels per row of a
strip: small enough for the nearest cache. Inputs are trusted: see `tiles.Tiles`.

A Gaussian comes as the LDL^T factors of its conic (see `projection`): with (dx, dy) measured from its center,
`alpha = opacity exp(-(a (dx + k dy)^2 + m dy^2) / 2) = 2^(log2(opacity) - (root dx + root k dy)^2 - m_log2 dy^2)`,
where `root = sqrt(a log2(e) / 2)` and `m_log2 = m log2(e) / 2`.

The backward pass is the same walk again. With weights w_j, colors c_j (z among them), cotangents v and final
transmittance T_end, Gaussian i at one pixel gets `dL/dalpha_i = T_i (c_i . v) - rest_i / (1 - alpha_i)`, where
`rest_i = sum_{j > i} w_j (c_j . v) + T_end (background . v - v_alpha)`. `rest` starts as the whole sum, known from the
forward pass, and loses one term per Gaussian: no list is walked backwards. Each pair writes one row of partial sums;
`gather` adds them up per Gaussian in a fixed order and turns them into gradients. In this file `v_x` is dL/dx, and dp
is dL / d log alpha, 0 where ALPHA_MAX binds.
"""

from __future__ import annotations

from math import log2

import numpy as np
from numba import njit, prange

from ...compute import simd
from ...compute.parallel_kernels import parallel_njit
from ...compute.simd import (
    LANES,
    broadcast,
    fma,
    lane_numbers,
    larger,
    load,
    magnitude,
    prefetch,
    smaller,
    store,
    total,
    where_ge,
)
from ..constants import ALPHA_MAX, ALPHA_MIN, STOP_TRANSMITTANCE
from . import tiles
from .tiles import FIRST_ROWS, ID, SLOPES, SLOT, STRIPS, TILE_HEIGHT, TILE_WIDTH

f4 = np.float32
LOG2_ALPHA_MIN, MAX_ALPHA, STOP = f4(log2(ALPHA_MIN)), f4(ALPHA_MAX), f4(STOP_TRANSMITTANCE)
FORWARD_ROW = 5 * LANES
"""Numbers per row of a strip: planes of transmittance, and of red, green, blue, depth so far."""
BACKWARD_ROW = 6 * LANES
"""Transmittance; cotangents of red, green, blue, depth; rest."""
FORWARD_STRIP, BACKWARD_STRIP = TILE_HEIGHT * FORWARD_ROW, TILE_HEIGHT * BACKWARD_ROW
CHECK_EVERY = 32
"""Pairs between two checks whether the whole tile is full."""
NUM_SUMS = 16
"""Sums over pixels of dp times 1, dx, dy, dx^2, dx dy, dy^2; of the weight times the four cotangents; and of the weight
times those of red, green, blue times dx, then times dy."""
GATHERED = 256
"""Gaussians per task of `gather`."""


@njit(forceinline=True)
def _log2_alpha(base, root_k, m_log2, log2_opacity, dy):
    # Exponent of alpha on the row at dy; `base` is root dx of the pixels. All are vectors, as is the result.
    u = fma(root_k, dy, base)
    return fma(-u, u, fma(-m_log2 * dy, dy, log2_opacity))


@njit(forceinline=True)
def blend(exponent, transmittance):
    """Alpha of the Gaussian at the pixels, its weight, which is 0 where it does not count, and the transmittance behind
    it.

    A transmittance below STOP marks a pixel that is full: its magnitude stays what it was and nothing more is added.
    All are vectors.
    """
    zero = broadcast(f4(0.0))
    alpha = smaller(simd.power_of_two(exponent), broadcast(MAX_ALPHA))
    alpha = where_ge(exponent, broadcast(LOG2_ALPHA_MIN), alpha, zero)
    behind = fma(-transmittance, alpha, transmittance)
    stop = broadcast(STOP)
    weight = where_ge(behind, stop, transmittance * alpha, zero)
    return alpha, weight, where_ge(behind, stop, behind, -magnitude(transmittance))


@njit(inline="always")
def _unpack(record, top):
    # One Gaussian as vectors: root, root k, m_log2, log2(opacity), y from `top`; colors and z; their slopes.
    root, m_log2, log2_opacity = (
        broadcast(record[tiles.ROOT]),
        broadcast(record[tiles.M_LOG2]),
        broadcast(record[tiles.LOG2_OPACITY]),
    )
    root_k, center_y = broadcast(record[tiles.ROOT] * record[tiles.K]), broadcast(record[tiles.Y] - top)
    red, green, blue, z = (
        broadcast(record[tiles.RED]),
        broadcast(record[tiles.GREEN]),
        broadcast(record[tiles.BLUE]),
        broadcast(record[tiles.Z]),
    )
    red_x, green_x, blue_x = broadcast(record[SLOPES]), broadcast(record[SLOPES + 1]), broadcast(record[SLOPES + 2])
    red_y, green_y, blue_y = broadcast(record[SLOPES + 3]), broadcast(record[SLOPES + 4]), broadcast(record[SLOPES + 5])
    geometry, color = (root, root_k, m_log2, log2_opacity, center_y), (red, green, blue, z)
    return geometry, color, (red_x, green_x, blue_x), (red_y, green_y, blue_y)


@njit(inline="always")
def _is_full(state):
    # Whether no pixel of the tile can take anything more.
    largest = load(state, 0)
    for row in range(1, STRIPS * TILE_HEIGHT):
        largest = larger(largest, load(state, row * FORWARD_ROW))
    lanes = np.empty(LANES, f4)
    store(lanes, 0, largest)
    return lanes.max() < STOP


@njit(inline="always")
def _blend_pair(record, pair, left, top, state):
    # Blends one Gaussian into the rows of one tile that it touches. (left, top): center of the tile's first pixel.
    geometry, color, along_x, along_y = _unpack(record, top)
    root, root_k, m_log2, log2_opacity, center_y = geometry
    red, green, blue, z = color
    red_x, green_x, blue_x = along_x
    red_y, green_y, blue_y = along_y
    for strip in range(STRIPS):
        first, end = pair[FIRST_ROWS + 2 * strip], pair[FIRST_ROWS + 2 * strip + 1]
        dx = lane_numbers() - broadcast(record[tiles.X] - left - f4(strip * LANES))
        base = root * dx
        column_red, column_green, column_blue = fma(red_x, dx, red), fma(green_x, dx, green), fma(blue_x, dx, blue)
        y = broadcast(f4(first))
        place = strip * FORWARD_STRIP + first * FORWARD_ROW
        for _ in range(first, end):
            dy = y - center_y
            _, weight, behind = blend(_log2_alpha(base, root_k, m_log2, log2_opacity, dy), load(state, place))
            store(state, place, behind)
            shown_red, shown_green = fma(red_y, dy, column_red), fma(green_y, dy, column_green)
            shown_blue = fma(blue_y, dy, column_blue)
            store(state, place + LANES, fma(weight, shown_red, load(state, place + LANES)))
            store(state, place + 2 * LANES, fma(weight, shown_green, load(state, place + 2 * LANES)))
            store(state, place + 3 * LANES, fma(weight, shown_blue, load(state, place + 3 * LANES)))
            store(state, place + 4 * LANES, fma(weight, z, load(state, place + 4 * LANES)))
            place += FORWARD_ROW
            y = y + broadcast(f4(1.0))


@njit(cache=True, error_model="numpy")
def _blend_tile(records, pairs, left, top, columns, rows, state):
    # Blends the pairs of one tile, near to far, and returns how many it needed before all pixels were full.
    state[:] = f4(0.0)  # pixels outside the image are full
    for r in range(rows):
        for c in range(columns):
            state[c // LANES * FORWARD_STRIP + r * FORWARD_ROW + c % LANES] = f4(1.0)
    flat_records = records.reshape(-1)
    for p in range(len(pairs)):
        prefetch(flat_records, pairs[min(p + tiles.AHEAD, len(pairs) - 1), ID] * tiles.RECORD_SIZE)
        _blend_pair(records[pairs[p, ID]], pairs[p], f4(left + 0.5), f4(top + 0.5), state)
        if p % CHECK_EVERY == CHECK_EVERY - 1 and _is_full(state):
            return p + 1
    return len(pairs)


@parallel_njit(error_model="numpy")
def composite_forward(
    records, pairs, tile_starts, by_cost, workers, background, color, depth, transmittance, tile_ends
):
    # Writes color (H, W, 3), depth (H, W), transmittance (H, W), and tile_ends (L,): where each tile's list was left.
    height, width = depth.shape
    tiles_x = (width + TILE_WIDTH - 1) // TILE_WIDTH
    for worker in prange(workers):
        state = np.empty(STRIPS * FORWARD_STRIP, f4)
        for index in range(worker, by_cost.size, workers):
            tile = by_cost[index]
            top, left = tile // tiles_x * TILE_HEIGHT, tile % tiles_x * TILE_WIDTH
            rows, columns = min(TILE_HEIGHT, height - top), min(TILE_WIDTH, width - left)
            start, end = tile_starts[tile], tile_starts[tile + 1]
            tile_ends[tile] = start + _blend_tile(records, pairs[start:end], left, top, columns, rows, state)
            for r in range(rows):
                for c in range(columns):
                    place = c // LANES * FORWARD_STRIP + r * FORWARD_ROW + c % LANES
                    y, x, t = top + r, left + c, abs(state[place])
                    color[y, x, 0] = state[place + LANES] + t * background[0]
                    color[y, x, 1] = state[place + 2 * LANES] + t * background[1]
                    color[y, x, 2] = state[place + 3 * LANES] + t * background[2]
                    depth[y, x] = state[place + 4 * LANES]
                    transmittance[y, x] = t


@njit(inline="always")
def _differentiate_pair(record, pair, left, top, state, sums):
    # Walks the same rows as the forward pass. Writes sums (NUM_SUMS,).
    geometry, color, along_x, along_y = _unpack(record, top)
    root, root_k, m_log2, log2_opacity, center_y = geometry
    red, green, blue, z = color
    red_x, green_x, blue_x = along_x
    red_y, green_y, blue_y = along_y
    one, zero = broadcast(f4(1.0)), broadcast(f4(0.0))
    s_1 = s_x = s_y = s_xx = s_xy = s_yy = s_red = s_green = s_blue = s_z = zero
    s_red_x = s_green_x = s_blue_x = s_red_y = s_green_y = s_blue_y = zero
    for strip in range(STRIPS):
        first, end = pair[FIRST_ROWS + 2 * strip], pair[FIRST_ROWS + 2 * strip + 1]
        dx = lane_numbers() - broadcast(record[tiles.X] - left - f4(strip * LANES))
        base = root * dx
        y = broadcast(f4(first))
        shade_red, shade_green, shade_blue = fma(red_x, dx, red), fma(green_x, dx, green), fma(blue_x, dx, blue)
        # dx is the same on all rows: its sums can wait until the strip is done
        column_1 = column_y = column_red = column_green = column_blue = zero
        place = strip * BACKWARD_STRIP + first * BACKWARD_ROW
        for _ in range(first, end):
            dy = y - center_y
            transmittance = load(state, place)
            alpha, weight, behind = blend(_log2_alpha(base, root_k, m_log2, log2_opacity, dy), transmittance)
            store(state, place, behind)
            v_red, v_green = load(state, place + LANES), load(state, place + 2 * LANES)
            v_blue, v_z = load(state, place + 3 * LANES), load(state, place + 4 * LANES)
            shown_red, shown_green = fma(red_y, dy, shade_red), fma(green_y, dy, shade_green)
            shown_blue = fma(blue_y, dy, shade_blue)
            gain = weight * fma(shown_red, v_red, fma(shown_green, v_green, fma(shown_blue, v_blue, z * v_z)))
            rest = load(state, place + 5 * LANES) - gain
            store(state, place + 5 * LANES, rest)
            # rest alpha / (1 - alpha), as weight = T alpha and behind = T (1 - alpha)
            dp = where_ge(alpha, broadcast(MAX_ALPHA), zero, gain - rest * weight / behind)
            dp_dy = dp * dy
            column_1 = column_1 + dp
            column_y = column_y + dp_dy
            s_yy = fma(dp_dy, dy, s_yy)
            v_red, v_green, v_blue = weight * v_red, weight * v_green, weight * v_blue
            column_red, column_green, column_blue = column_red + v_red, column_green + v_green, column_blue + v_blue
            s_red_y, s_green_y = fma(v_red, dy, s_red_y), fma(v_green, dy, s_green_y)
            s_blue_y = fma(v_blue, dy, s_blue_y)
            s_z = fma(weight, v_z, s_z)
            place += BACKWARD_ROW
            y = y + one
        column_x = column_1 * dx
        s_1, s_x, s_y = s_1 + column_1, s_x + column_x, s_y + column_y
        s_xx, s_xy = fma(column_x, dx, s_xx), fma(column_y, dx, s_xy)
        s_red, s_green, s_blue = s_red + column_red, s_green + column_green, s_blue + column_blue
        s_red_x, s_green_x = fma(column_red, dx, s_red_x), fma(column_green, dx, s_green_x)
        s_blue_x = fma(column_blue, dx, s_blue_x)
    sums[0], sums[1], sums[2] = total(s_1), total(s_x), total(s_y)
    sums[3], sums[4], sums[5] = total(s_xx), total(s_xy), total(s_yy)
    sums[6], sums[7], sums[8], sums[9] = total(s_red), total(s_green), total(s_blue), total(s_z)
    sums[10], sums[11], sums[12] = total(s_red_x), total(s_green_x), total(s_blue_x)
    sums[13], sums[14], sums[15] = total(s_red_y), total(s_green_y), total(s_blue_y)


@njit(cache=True, error_model="numpy")
def _read_tile(color, depth, transmittance, v_color, v_depth, v_alpha, left, top, state):
    # Fills the planes of one tile.
    height, width = depth.shape
    state[:] = f4(-1.0)  # pixels outside the image are full
    for strip in range(STRIPS):
        x = left + strip * LANES
        for r in range(min(TILE_HEIGHT, height - top)):
            y, place = top + r, strip * BACKWARD_STRIP + r * BACKWARD_ROW
            for q in range(min(LANES, width - x)):
                v_r, v_g, v_b, v_z = v_color[y, x + q, 0], v_color[y, x + q, 1], v_color[y, x + q, 2], v_depth[y, x + q]
                shown = v_r * color[y, x + q, 0] + v_g * color[y, x + q, 1] + v_b * color[y, x + q, 2]
                state[place + q] = f4(1.0)
                state[place + LANES + q] = v_r
                state[place + 2 * LANES + q] = v_g
                state[place + 3 * LANES + q] = v_b
                state[place + 4 * LANES + q] = v_z
                shown += v_z * depth[y, x + q]
                state[place + 5 * LANES + q] = shown - v_alpha[y, x + q] * transmittance[y, x + q]


@njit(cache=True, error_model="numpy")
def _differentiate_tile(records, pairs, needed, left, top, state, sums):
    # Writes the partial sums of one tile's pairs, near to far; zeros for those that the forward pass did not need.
    flat_records, flat_sums = records.reshape(-1), sums.reshape(-1)
    for p in range(needed):
        pair = pairs[p]
        ahead = pairs[min(p + tiles.AHEAD, needed - 1)]
        prefetch(flat_records, ahead[ID] * tiles.RECORD_SIZE)
        prefetch(flat_sums, ahead[SLOT] * NUM_SUMS)
        _differentiate_pair(records[pair[ID]], pair, f4(left + 0.5), f4(top + 0.5), state, sums[pair[SLOT]])
    for p in range(needed, len(pairs)):
        sums[pairs[p, SLOT]] = f4(0.0)


@parallel_njit(error_model="numpy")
def composite_backward(
    records, pairs, tile_starts, tile_ends, by_cost, workers,
    color, depth, transmittance, v_color, v_depth, v_alpha, sums,
):  # fmt: skip
    # One task per worker, as in the forward pass. Writes sums (P, NUM_SUMS), one row per slot.
    width = depth.shape[1]
    tiles_x = (width + TILE_WIDTH - 1) // TILE_WIDTH
    for worker in prange(workers):
        state = np.empty(STRIPS * BACKWARD_STRIP, f4)
        for index in range(worker, by_cost.size, workers):
            tile = by_cost[index]
            top, left = tile // tiles_x * TILE_HEIGHT, tile % tiles_x * TILE_WIDTH
            _read_tile(color, depth, transmittance, v_color, v_depth, v_alpha, left, top, state)
            start, end = tile_starts[tile], tile_starts[tile + 1]
            needed = tile_ends[tile] - start
            _differentiate_tile(records, pairs[start:end], needed, left, top, state, sums)


@parallel_njit(error_model="numpy")
def gather(
    sums, slot_starts, conic_ldl, color_slopes2d, opacities,
    v_means2d, v_conic_ldl, v_z, v_colors, v_color_slopes2d, v_opacities,
):  # fmt: skip
    # One task per GATHERED Gaussians: sums the slots of each in order; writes one row of each v_*.
    # log alpha = log opacity - (a u^2 + m dy^2) / 2 with u = dx + k dy; moving the center moves (dx, dy) the other way.
    num = len(opacities)
    for block in prange((num + GATHERED - 1) // GATHERED):
        s = np.empty(NUM_SUMS, f4)
        for g in range(block * GATHERED, min(num, (block + 1) * GATHERED)):
            s[:] = f4(0.0)
            for slot in range(slot_starts[g], slot_starts[g + 1]):
                for i in range(NUM_SUMS):
                    s[i] += sums[slot, i]
            s_1, s_x, s_y, s_xx, s_xy, s_yy = s[0], s[1], s[2], s[3], s[4], s[5]
            s_red, s_green, s_blue, s_z = s[6], s[7], s[8], s[9]
            for i in range(3):
                v_color_slopes2d[g, 0, i], v_color_slopes2d[g, 1, i] = s[10 + i], s[13 + i]
            a, k, m = conic_ldl[g, 0], conic_ldl[g, 1], conic_ldl[g, 2]
            u_y = s_xy + k * s_yy
            v_x = a * (s_x + k * s_y)
            shade = color_slopes2d[g]
            v_means2d[g, 0] = v_x - (shade[0, 0] * s_red + shade[0, 1] * s_green + shade[0, 2] * s_blue)
            v_means2d[g, 1] = k * v_x + m * s_y - (shade[1, 0] * s_red + shade[1, 1] * s_green + shade[1, 2] * s_blue)
            v_conic_ldl[g, 0] = f4(-0.5) * (s_xx + k * (s_xy + u_y))
            v_conic_ldl[g, 1] = -a * u_y
            v_conic_ldl[g, 2] = f4(-0.5) * s_yy
            v_opacities[g] = s_1 / opacities[g] if slot_starts[g + 1] > slot_starts[g] else f4(0.0)
            v_colors[g, 0], v_colors[g, 1], v_colors[g, 2], v_z[g] = s_red, s_green, s_blue, s_z
