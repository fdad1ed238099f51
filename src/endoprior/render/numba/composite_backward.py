"""Front-to-back compositing of the tiles, backward: the same walk again, with gradients.

With weights w_j, colors c_j (z among them), cotangents v and final transmittance T_end, Gaussian i at one pixel gets
`dL/dalpha_i = T_i (c_i . v) - rest_i / (1 - alpha_i)`, where `rest_i = sum_{j > i} w_j (c_j . v) + T_end (background .
v - v_alpha)`. `rest` starts as the whole sum, known from the forward pass, and loses one term per Gaussian: no list is
walked backwards. Each pair writes one row of partial sums; `gather` adds them up per Gaussian in a fixed order and
turns them into gradients. In this file `v_x` is dL/dx, and dp is dL / d log alpha, 0 where ALPHA_MAX binds.
"""

from __future__ import annotations

import numpy as np
from numba import njit, prange

from ...compute.simd import LANES, fma, lane_numbers, load, splat, store, total, where_ge
from . import tiles
from .pixels import LARGEST_ALPHA, blend, log2_alpha
from .tiles import FIRST_ROWS, ID, SLOPES, SLOT, STRIPS, TILE_HEIGHT, TILE_WIDTH

PLANES = 6
"""Transmittance; cotangents of red, green, blue, depth; rest."""
ROW = PLANES * LANES
STRIP_SIZE = TILE_HEIGHT * ROW
NUM_SUMS = 16
"""Sums over pixels of dp times 1, dx, dy, dx^2, dx dy, dy^2; of the weight times the four cotangents; and of the weight
times those of red, green, blue times dx, then times dy."""
f4 = np.float32


@njit(inline="always")
def _differentiate_pair(record, pair, left, top, state, sums):
    # Walks the same rows as the forward pass. (left, top): center of the tile's first pixel. Writes sums (NUM_SUMS,).
    root, m_log2 = record[tiles.ROOT], splat(record[tiles.M_LOG2])
    root_k, log2_opacity = splat(root * record[tiles.K]), splat(record[tiles.LOG2_OPACITY])
    red, green, blue = splat(record[tiles.RED]), splat(record[tiles.GREEN]), splat(record[tiles.BLUE])
    z, center_y = splat(record[tiles.Z]), splat(record[tiles.Y] - top)
    red_x, green_x, blue_x = splat(record[SLOPES]), splat(record[SLOPES + 1]), splat(record[SLOPES + 2])
    red_y, green_y, blue_y = splat(record[SLOPES + 3]), splat(record[SLOPES + 4]), splat(record[SLOPES + 5])
    one, zero = splat(f4(1.0)), splat(f4(0.0))
    s_1 = s_x = s_y = s_xx = s_xy = s_yy = s_red = s_green = s_blue = s_z = zero
    s_red_x = s_green_x = s_blue_x = s_red_y = s_green_y = s_blue_y = zero
    for strip in range(STRIPS):
        first, end = pair[FIRST_ROWS + 2 * strip], pair[FIRST_ROWS + 2 * strip + 1]
        dx = lane_numbers() - splat(record[tiles.X] - left - f4(strip * LANES))
        base = splat(root) * dx
        y = splat(f4(first))
        shade_red, shade_green, shade_blue = fma(red_x, dx, red), fma(green_x, dx, green), fma(blue_x, dx, blue)
        # dx is the same on all rows: its sums can wait until the strip is done
        column_1 = column_y = column_red = column_green = column_blue = zero
        place = strip * STRIP_SIZE + first * ROW
        for _ in range(first, end):
            dy = y - center_y
            transmittance = load(state, place)
            alpha, weight, behind = blend(log2_alpha(base, root_k, m_log2, log2_opacity, dy), transmittance)
            store(state, place, behind)
            v_red, v_green = load(state, place + LANES), load(state, place + 2 * LANES)
            v_blue, v_z = load(state, place + 3 * LANES), load(state, place + 4 * LANES)
            shown_red, shown_green = fma(red_y, dy, shade_red), fma(green_y, dy, shade_green)
            shown_blue = fma(blue_y, dy, shade_blue)
            gain = weight * fma(shown_red, v_red, fma(shown_green, v_green, fma(shown_blue, v_blue, z * v_z)))
            rest = load(state, place + 5 * LANES) - gain
            store(state, place + 5 * LANES, rest)
            # rest alpha / (1 - alpha), as weight = T alpha and behind = T (1 - alpha)
            dp = where_ge(alpha, splat(LARGEST_ALPHA), zero, gain - rest * weight / behind)
            dp_dy = dp * dy
            column_1 = column_1 + dp
            column_y = column_y + dp_dy
            s_yy = fma(dp_dy, dy, s_yy)
            v_red, v_green, v_blue = weight * v_red, weight * v_green, weight * v_blue
            column_red, column_green, column_blue = column_red + v_red, column_green + v_green, column_blue + v_blue
            s_red_y, s_green_y = fma(v_red, dy, s_red_y), fma(v_green, dy, s_green_y)
            s_blue_y = fma(v_blue, dy, s_blue_y)
            s_z = fma(weight, v_z, s_z)
            place += ROW
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
            y, place = top + r, strip * STRIP_SIZE + r * ROW
            for q in range(min(LANES, width - x)):
                v_r, v_g, v_b, v_z = v_color[y, x + q, 0], v_color[y, x + q, 1], v_color[y, x + q, 2], v_depth[y, x + q]
                shown = v_r * color[y, x + q, 0] + v_g * color[y, x + q, 1] + v_b * color[y, x + q, 2]
                state[place + q] = f4(1.0)
                state[place + LANES + q] = v_r
                state[place + 2 * LANES + q] = v_g
                state[place + 3 * LANES + q] = v_b
                state[place + 4 * LANES + q] = v_z
                state[place + 5 * LANES + q] = (
                    shown + v_z * depth[y, x + q] - v_alpha[y, x + q] * transmittance[y, x + q]
                )


@njit(cache=True, error_model="numpy")
def _differentiate_tile(records, pairs, needed, left, top, state, sums):
    # Writes the partial sums of one tile's pairs, near to far; zeros for those that the forward pass did not need.
    for p in range(needed):
        pair = pairs[p]
        _differentiate_pair(records[pair[ID]], pair, f4(left + 0.5), f4(top + 0.5), state, sums[pair[SLOT]])
    for p in range(needed, len(pairs)):
        sums[pairs[p, SLOT]] = f4(0.0)


@njit(parallel=True, cache=True, error_model="numpy")
def composite_backward(
    records, pairs, tile_starts, tile_ends, by_cost, workers,
    color, depth, transmittance, v_color, v_depth, v_alpha, sums,
):  # fmt: skip
    # One task per worker, as in the forward pass. Writes sums (P, NUM_SUMS), one row per slot.
    width = depth.shape[1]
    tiles_x = (width + TILE_WIDTH - 1) // TILE_WIDTH
    for worker in prange(workers):
        state = np.empty(STRIPS * STRIP_SIZE, f4)
        for index in range(worker, by_cost.size, workers):
            tile = by_cost[index]
            top, left = tile // tiles_x * TILE_HEIGHT, tile % tiles_x * TILE_WIDTH
            _read_tile(color, depth, transmittance, v_color, v_depth, v_alpha, left, top, state)
            start, end = tile_starts[tile], tile_starts[tile + 1]
            needed = tile_ends[tile] - start
            _differentiate_tile(records, pairs[start:end], needed, left, top, state, sums)


@njit(parallel=True, cache=True, error_model="numpy")
def gather(
    sums, slot_starts, conic_ldl, color_slopes2d, opacities,
    v_means2d, v_conic_ldl, v_z, v_colors, v_color_slopes2d, v_opacities,
):  # fmt: skip
    # One iteration per Gaussian: sums its slots in order; writes one row of each v_*.
    # log alpha = log opacity - (a u^2 + m dy^2) / 2 with u = dx + k dy; moving the center moves (dx, dy) the other way.
    for g in prange(slot_starts.size - 1):
        s_1 = s_x = s_y = s_xx = s_xy = s_yy = s_red = s_green = s_blue = s_z = f4(0.0)
        v_color_slopes2d[g] = f4(0.0)
        for slot in range(slot_starts[g], slot_starts[g + 1]):
            s_1 += sums[slot, 0]
            s_x += sums[slot, 1]
            s_y += sums[slot, 2]
            s_xx += sums[slot, 3]
            s_xy += sums[slot, 4]
            s_yy += sums[slot, 5]
            s_red += sums[slot, 6]
            s_green += sums[slot, 7]
            s_blue += sums[slot, 8]
            s_z += sums[slot, 9]
            for i in range(3):
                v_color_slopes2d[g, 0, i] += sums[slot, 10 + i]
                v_color_slopes2d[g, 1, i] += sums[slot, 13 + i]
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
