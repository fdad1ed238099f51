# pyright: reportGeneralTypeIssues=false
"""Front-to-back compositing as Triton kernels, forward and backward.

One program of one warp per tile: nothing has to wait for other warps, and checking all pixels takes five shuffles.
Pixels are (ROWS, 32) blocks whose first axis lies within a lane, so that a Gaussian's numbers are loaded, and its
offset from the lane's column is computed, once for ROWS pixels, and ROWS values are added up before the lanes are.
With (dx, dy) from the Gaussian's center and `u = root dy + root_k dx`, `alpha = 2^(log2(opacity) - m_log2 dx^2 - u^2)`:
see `tiles` for the records, and `projection` for the factors.

The backward pass is the same walk again. With weights w_j, colors c_j (z among them), cotangents v and final
transmittance T_end, Gaussian i at one pixel gets `dL/dalpha_i = T_i (c_i . v) - rest_i / (1 - alpha_i)`, where
`rest_i = sum_{j > i} w_j (c_j . v) + T_end (background . v - v_alpha)`. `rest` starts as the whole sum, known from the
forward pass, and loses one term per Gaussian: no list is walked backwards, and both passes take the same decisions.
Every pair belongs to one tile, so its program writes that pair's sums, and `gather` adds up each Gaussian's pairs in a
fixed order: no atomics, and results are bit-identical. In this file `v_x` is dL/dx, and dp is dL / d log alpha, 0 where
ALPHA_MAX binds.
"""

from __future__ import annotations

import triton
import triton.language as tl

from ..constants import ALPHA_MAX, STOP_TRANSMITTANCE
from .launch import load_three, store_three
from .tiles import BLUE, HALF_LOG2_E, LOG2_ALPHA_MIN, M_LOG2, RECORD, RED, ROOT, SLOPES, TILE_WIDTH, X

NUM_SUMS = tl.constexpr(16)
"""Sums over a pair's pixels of dp times 1, dx, dx^2, u, u^2, u dx; of the weight times the four cotangents; and of the
weight times those of red, green, blue times dx, then times dy."""
SIZES = ["width", "height", "tiles_x"]
"""Arguments that may be any number without another version being compiled."""
_ALPHA_MAX, _STOP = tl.constexpr(ALPHA_MAX), tl.constexpr(STOP_TRANSMITTANCE)
_WIDTH = tl.constexpr(TILE_WIDTH)
_CHECK_EVERY = tl.constexpr(16)  # pairs between two checks whether the whole tile is full


@triton.jit
def _pixels(tile, tiles_x, width, height, ROWS: tl.constexpr):
    # Of a tile's pixels: x (1, 32), y of each lane's first (1, 32), row step (ROWS, 1), places, and which are inside.
    lane, step = tl.arange(0, 32)[None, :], 2 * tl.arange(0, ROWS)[:, None]
    column = tile % tiles_x * _WIDTH + lane // 2
    first_row = tile // tiles_x * (2 * ROWS) + lane % 2
    row = first_row + step
    inside = (column < width) & (row < height)
    return column + 0.5, first_row + 0.5, step.to(tl.float32), row * width + column, inside


@triton.jit
def _record(records, ranks, pair, end):
    # What `_row` returns of one pair; zeros past the end of the list.
    return _row(records, tl.load(ranks + pair, pair < end, 0), pair < end)


@triton.jit
def _two(row, i: tl.constexpr, known):
    # Two neighboring numbers of a record in one load of 64 bits: half the loads of the inner loops.
    both = tl.load((row + i).to(tl.pointer_type(tl.int64)), known, 0)
    return both.to(tl.int32).to(tl.float32, bitcast=True), (both >> 32).to(tl.int32).to(tl.float32, bitcast=True)


@triton.jit
def _row(records, rank, known):
    # Center (x, y), root, root_k, m_log2, log2_opacity, red, green, blue, z and the six slopes of a rank's Gaussian.
    row = records + rank * RECORD
    x, y = _two(row, X, known)
    root, root_k = _two(row, ROOT, known)
    m_log2, log2_opacity = _two(row, M_LOG2, known)
    red, green = _two(row, RED, known)
    blue, z = _two(row, BLUE, known)
    red_x, green_x = _two(row, SLOPES, known)
    blue_x, red_y = _two(row, SLOPES + 2, known)
    green_y, blue_y = _two(row, SLOPES + 4, known)
    geometry = x, y, root, root_k, m_log2, log2_opacity
    return geometry, (red, green, blue, z), (red_x, green_x, blue_x), (red_y, green_y, blue_y)


@triton.jit
def _shades(color, along_x, along_y, dx, dy, step):
    # Red, green, blue and z at the pixels; dy is that of each lane's first row.
    red, green, blue, z = color
    red_x, green_x, blue_x = along_x
    red_y, green_y, blue_y = along_y
    return (
        tl.fma(step, red_y, red + red_x * dx + red_y * dy),
        tl.fma(step, green_y, green + green_x * dx + green_y * dy),
        tl.fma(step, blue_y, blue + blue_x * dx + blue_y * dy),
        z,
    )


@triton.jit
def _blend(geometry, x, y, step, transmittance):
    # Alpha of a Gaussian, the transmittance behind it, dx, dy of the lane's first row, and u. Fused operations are
    # named, so that no compiler chooses them and both passes come to the same bits. Times -1 costs nothing; a minus is
    # a subtraction from 0 in Triton 3.7.
    gx, gy, root, root_k, m_log2, log2_opacity = geometry
    dx, dy = x - gx, y - gy
    u = tl.fma(step, root, tl.fma(root, dy, root_k * dx))
    exponent = tl.fma(u * -1.0, u, tl.fma(m_log2 * dx * -1.0, dx, log2_opacity))
    alpha = tl.minimum(tl.exp2(exponent), _ALPHA_MAX)
    alpha = tl.where(exponent >= LOG2_ALPHA_MIN, alpha, 0.0)
    return alpha, tl.fma(transmittance * -1.0, alpha, transmittance), dx, dy, u


@triton.jit(do_not_specialize=SIZES)
def composite_forward(
    records, ranks, tile_starts, background, width, height, tiles_x,
    color, depth, transmittance, tile_ends, ROWS: tl.constexpr,
):  # fmt: skip
    """One program per tile. Writes color (H, W, 3), depth and transmittance (H, W), and tile_ends (L,): where each
    tile's list was left."""
    tile = tl.program_id(0)
    x, y, step, place, inside = _pixels(tile, tiles_x, width, height, ROWS)
    pair, end = tl.load(tile_starts + tile), tl.load(tile_starts + tile + 1)
    t = tl.where(inside, 1.0, -1.0)  # negative: full; its magnitude stays what it was
    red, green, blue, z = tl.zeros_like(t), tl.zeros_like(t), tl.zeros_like(t), tl.zeros_like(t)
    # Loads run ahead: the record one pair, its rank two, so that few warps suffice to hide how long they take.
    geometry, shade, along_x, along_y = _record(records, ranks, pair, end)
    rank = tl.load(ranks + pair + 1, pair + 1 < end, 0)
    while (pair < end) & (tl.max(tl.max(t, 0), 0) > 0):
        chunk_end = tl.minimum(pair + _CHECK_EVERY, end)
        for p in tl.range(pair, chunk_end, loop_unroll_factor=2):
            next_geometry, next_shade, next_x, next_y = _row(records, rank, True)
            rank = tl.load(ranks + p + 2, p + 2 < end, 0)
            alpha, behind, dx, dy, _ = _blend(geometry, x, y, step, t)
            r, g, b, gz = _shades(shade, along_x, along_y, dx, dy, step)
            weight = tl.where(behind >= _STOP, t * alpha, 0.0)
            t = tl.where(behind >= _STOP, behind, tl.abs(t) * -1.0)
            red += weight * r
            green += weight * g
            blue += weight * b
            z += weight * gz
            geometry, shade, along_x, along_y = next_geometry, next_shade, next_x, next_y
        pair = chunk_end
    tl.store(tile_ends + tile, pair)
    t = tl.abs(t)
    red, green = red + t * tl.load(background), green + t * tl.load(background + 1)
    store_three(color + 3 * place, red, green, blue + t * tl.load(background + 2), inside)
    tl.store(depth + place, z, inside)
    tl.store(transmittance + place, t, inside)


@triton.jit
def _exchange(a, b, lane, BIT: tl.constexpr):
    # Adds the lanes that differ in BIT: those without it keep the sums of a, those with it the sums of b.
    upper = (lane & BIT) != 0
    return tl.where(upper, b, a) + tl.gather(tl.where(upper, a, b), lane ^ BIT, 0)


@triton.jit
def _totals(v0, v1, v2, v3, v4, v5, v6, v7, v8, v9, v10, v11, v12, v13, v14, v15, lane):
    # Sums of sixteen values over all lanes, one sum per lane: see `_number` for which. 16 shuffles instead of 80.
    v0, v2, v4 = _exchange(v0, v1, lane, 16), _exchange(v2, v3, lane, 16), _exchange(v4, v5, lane, 16)
    v6, v8, v10 = _exchange(v6, v7, lane, 16), _exchange(v8, v9, lane, 16), _exchange(v10, v11, lane, 16)
    v12, v14 = _exchange(v12, v13, lane, 16), _exchange(v14, v15, lane, 16)
    v0, v4 = _exchange(v0, v2, lane, 8), _exchange(v4, v6, lane, 8)
    v8, v12 = _exchange(v8, v10, lane, 8), _exchange(v12, v14, lane, 8)
    v0, v8 = _exchange(v0, v4, lane, 4), _exchange(v8, v12, lane, 4)
    v0 = _exchange(v0, v8, lane, 2)
    return _exchange(v0, v0, lane, 1)


@triton.jit
def _number(lane):
    # Which of the sixteen sums a lane has after `_totals`, and whether it is the one to write it.
    number = (lane >> 4) + ((lane & 8) >> 2) + (lane & 4) + ((lane & 2) << 2)
    return number, (lane & 1) == 0


@triton.jit(do_not_specialize=SIZES)
def composite_backward(
    records, ranks, slots, tile_starts, tile_ends, width, height, tiles_x,
    color, depth, transmittance, v_color, v_depth, v_alpha, sums, ROWS: tl.constexpr,
):  # fmt: skip
    """One program per tile. Writes sums (P, NUM_SUMS) by slot; zeros for pairs the forward pass did not need."""
    tile = tl.program_id(0)
    x, y, step, place, inside = _pixels(tile, tiles_x, width, height, ROWS)
    v_red, v_green, v_blue = load_three(v_color + 3 * place, inside)
    v_z = tl.load(v_depth + place, inside, 0.0)
    rest = v_red * tl.load(color + 3 * place, inside, 0.0)
    rest += v_green * tl.load(color + 3 * place + 1, inside, 0.0)
    rest += v_blue * tl.load(color + 3 * place + 2, inside, 0.0)
    rest += v_z * tl.load(depth + place, inside, 0.0)
    rest -= tl.load(v_alpha + place, inside, 0.0) * tl.load(transmittance + place, inside, 0.0)
    t = tl.where(inside, 1.0, -1.0)
    lane = tl.arange(0, 32)
    number, writes = _number(lane)
    start, needed, end = tl.load(tile_starts + tile), tl.load(tile_ends + tile), tl.load(tile_starts + tile + 1)
    geometry, shade, along_x, along_y = _record(records, ranks, start, needed)
    rank = tl.load(ranks + start + 1, start + 1 < needed, 0)
    slot = tl.load(slots + start, start < needed, 0)
    for p in tl.range(start, needed, loop_unroll_factor=2):
        next_geometry, next_shade, next_x, next_y = _row(records, rank, True)
        rank = tl.load(ranks + p + 2, p + 2 < needed, 0)
        next_slot = tl.load(slots + p + 1, p + 1 < needed, 0)
        alpha, behind, dx, dy, u = _blend(geometry, x, y, step, t)
        r, g, b, gz = _shades(shade, along_x, along_y, dx, dy, step)
        weight = tl.where(behind >= _STOP, t * alpha, 0.0)
        gain = weight * (r * v_red + g * v_green + b * v_blue + gz * v_z)
        rest -= gain
        # rest alpha / (1 - alpha), as weight = T alpha and behind = T (1 - alpha). A division is ten instructions, the
        # square of the inverse root two.
        inverse_root = tl.rsqrt(tl.abs(behind))
        pulled = gain - rest * weight * (inverse_root * inverse_root)
        dp = tl.where((behind >= _STOP) & (alpha < _ALPHA_MAX), pulled, 0.0)
        t = tl.where(behind >= _STOP, behind, tl.abs(t) * -1.0)
        # Sums over the lane's pixels first: dx is the same for all of them, dy the first row's plus the step.
        dp_u = dp * u
        dx, dy = tl.sum(dx, 0), tl.sum(dy, 0)
        w_red, w_green, w_blue = weight * v_red, weight * v_green, weight * v_blue
        s_1, s_u, s_uu = tl.sum(dp, 0), tl.sum(dp_u, 0), tl.sum(dp_u * u, 0)
        s_red, s_green = tl.sum(w_red, 0), tl.sum(w_green, 0)
        s_blue, s_z = tl.sum(w_blue, 0), tl.sum(weight * v_z, 0)
        s_x = s_1 * dx
        totals = _totals(
            s_1, s_x, s_x * dx, s_u, s_uu, s_u * dx, s_red, s_green, s_blue, s_z,
            s_red * dx, s_green * dx, s_blue * dx,
            tl.sum(w_red * step, 0) + s_red * dy, tl.sum(w_green * step, 0) + s_green * dy,
            tl.sum(w_blue * step, 0) + s_blue * dy, lane,
        )  # fmt: skip
        tl.store(sums + slot * NUM_SUMS + number, totals, writes)
        slot = next_slot
        geometry, shade, along_x, along_y = next_geometry, next_shade, next_x, next_y
    for p in range(needed, end):
        tl.store(sums + tl.load(slots + p) * NUM_SUMS + number, tl.zeros_like(number), writes)


@triton.jit
def _shift(slopes, red, green, blue, some):
    # Change of the color where the center moves by 1 px, times the cotangents of the color.
    along_red, along_green, along_blue = load_three(slopes, some)
    return along_red * red + along_green * green + along_blue * blue


@triton.jit(do_not_specialize=["num"])
def gather(
    sums, slot_ends, order, conic_ldl, color_slopes2d, opacities, num,
    v_means2d, v_conic_ldl, v_z, v_colors, v_color_slopes2d, v_opacities,
    BLOCK: tl.constexpr, SIDE_BY_SIDE: tl.constexpr,
):  # fmt: skip
    """One program per BLOCK ranks. Adds up the slots of each, SIDE_BY_SIDE at a time, and writes one row of each v_*.

    log alpha = log opacity - (a U^2 + m dx^2) / 2 with U = dy + k dx = u / root; moving the center moves (dx, dy) the
    other way.
    """
    rank = tl.program_id(0) * BLOCK + tl.arange(0, BLOCK)
    known = rank < num
    g = tl.load(order + rank, known, 0)
    start = tl.load(slot_ends + rank - 1, known & (rank > 0), 0)
    end = tl.load(slot_ends + rank, known, 0)
    s_1 = tl.zeros((BLOCK, SIDE_BY_SIDE), tl.float32)
    s_x, s_xx, s_u, s_uu, s_ux, s_red, s_green, s_blue, s_z = s_1, s_1, s_1, s_1, s_1, s_1, s_1, s_1, s_1
    s_red_x, s_green_x, s_blue_x, s_red_y, s_green_y, s_blue_y = s_1, s_1, s_1, s_1, s_1, s_1
    for i in range(0, tl.max(end - start, 0).to(tl.int32), SIDE_BY_SIDE):
        slot = start[:, None] + i + tl.arange(0, SIDE_BY_SIDE)[None, :]
        taken = slot < end[:, None]
        row = sums + slot * NUM_SUMS
        r_1, r_x, r_xx = load_three(row, taken)
        r_u, r_uu, r_ux = load_three(row + 3, taken)
        s_1, s_x, s_xx, s_u, s_uu, s_ux = s_1 + r_1, s_x + r_x, s_xx + r_xx, s_u + r_u, s_uu + r_uu, s_ux + r_ux
        r, g_, b = load_three(row + 6, taken)
        s_red, s_green, s_blue, s_z = s_red + r, s_green + g_, s_blue + b, s_z + tl.load(row + 9, taken, 0.0)
        r, g_, b = load_three(row + 10, taken)
        s_red_x, s_green_x, s_blue_x = s_red_x + r, s_green_x + g_, s_blue_x + b
        r, g_, b = load_three(row + 13, taken)
        s_red_y, s_green_y, s_blue_y = s_red_y + r, s_green_y + g_, s_blue_y + b
    some = known & (end > start)
    a, k = tl.load(conic_ldl + 3 * g, some, 1.0), tl.load(conic_ldl + 3 * g + 1, some, 0.0)
    inverse_root = 1.0 / tl.sqrt(a * HALF_LOG2_E)
    u_1, u_x = tl.sum(s_u, 1) * inverse_root, tl.sum(s_ux, 1) * inverse_root
    v_y = a * u_1
    v_x = k * v_y + tl.load(conic_ldl + 3 * g + 2, some, 0.0) * tl.sum(s_x, 1)
    red, green, blue = tl.sum(s_red, 1), tl.sum(s_green, 1), tl.sum(s_blue, 1)
    slopes, v_slopes = color_slopes2d + 6 * g, v_color_slopes2d + 6 * g
    tl.store(v_means2d + 2 * g, v_x - _shift(slopes, red, green, blue, some), known)
    tl.store(v_means2d + 2 * g + 1, v_y - _shift(slopes + 3, red, green, blue, some), known)
    store_three(v_slopes, tl.sum(s_red_x, 1), tl.sum(s_green_x, 1), tl.sum(s_blue_x, 1), known)
    store_three(v_slopes + 3, tl.sum(s_red_y, 1), tl.sum(s_green_y, 1), tl.sum(s_blue_y, 1), known)
    v_a, v_m = -0.5 * tl.sum(s_uu, 1) * inverse_root * inverse_root, -0.5 * tl.sum(s_xx, 1)
    store_three(v_conic_ldl + 3 * g, v_a, -a * u_x, v_m, known)
    tl.store(v_opacities + g, tl.sum(s_1, 1) / tl.load(opacities + g, some, 1.0), known)
    store_three(v_colors + 3 * g, red, green, blue, known)
    tl.store(v_z + g, tl.sum(s_z, 1), known)
