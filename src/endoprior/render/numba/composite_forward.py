"""Front-to-back compositing of the tiles, forward.

One task per worker, over every `workers`-th tile of the list sorted by cost, so that the workers finish together. A
tile keeps its pixels in one flat array `state[strip, row, plane, lane]`, with PLANES planes of LANES pixels per row of
a strip: small enough for the nearest cache. Inputs are trusted: see `tiles.Tiles`.
"""

from __future__ import annotations

import numpy as np
from numba import njit, prange

from ...compute.simd import LANES, fma, lane_numbers, larger, load, splat, store
from . import tiles
from .pixels import STOP, blend, log2_alpha
from .tiles import FIRST_ROWS, ID, SLOPES, STRIPS, TILE_HEIGHT, TILE_WIDTH

PLANES = 5
"""Transmittance; red, green, blue, depth so far."""
ROW = PLANES * LANES
"""Numbers per row of a strip."""
STRIP_SIZE = TILE_HEIGHT * ROW
CHECK_EVERY = 32
"""Pairs between two checks whether the whole tile is full."""
f4 = np.float32


@njit(inline="always")
def _is_full(state):
    # Whether no pixel of the tile can take anything more.
    largest = load(state, 0)
    for row in range(1, STRIPS * TILE_HEIGHT):
        largest = larger(largest, load(state, row * ROW))
    lanes = np.empty(LANES, f4)
    store(lanes, 0, largest)
    return lanes.max() < STOP


@njit(inline="always")
def _blend_pair(record, pair, left, top, state):
    # Blends one Gaussian into the rows of one tile that it touches. (left, top): center of the tile's first pixel.
    root, m_log2 = record[tiles.ROOT], splat(record[tiles.M_LOG2])
    root_k, log2_opacity = splat(root * record[tiles.K]), splat(record[tiles.LOG2_OPACITY])
    red, green, blue = splat(record[tiles.RED]), splat(record[tiles.GREEN]), splat(record[tiles.BLUE])
    z, center_y = splat(record[tiles.Z]), splat(record[tiles.Y] - top)
    red_x, green_x, blue_x = splat(record[SLOPES]), splat(record[SLOPES + 1]), splat(record[SLOPES + 2])
    red_y, green_y, blue_y = splat(record[SLOPES + 3]), splat(record[SLOPES + 4]), splat(record[SLOPES + 5])
    for strip in range(STRIPS):
        first, end = pair[FIRST_ROWS + 2 * strip], pair[FIRST_ROWS + 2 * strip + 1]
        dx = lane_numbers() - splat(record[tiles.X] - left - f4(strip * LANES))
        base = splat(root) * dx
        column_red, column_green, column_blue = fma(red_x, dx, red), fma(green_x, dx, green), fma(blue_x, dx, blue)
        y = splat(f4(first))
        place = strip * STRIP_SIZE + first * ROW
        for _ in range(first, end):
            dy = y - center_y
            _, weight, behind = blend(log2_alpha(base, root_k, m_log2, log2_opacity, dy), load(state, place))
            store(state, place, behind)
            shown_red, shown_green = fma(red_y, dy, column_red), fma(green_y, dy, column_green)
            shown_blue = fma(blue_y, dy, column_blue)
            store(state, place + LANES, fma(weight, shown_red, load(state, place + LANES)))
            store(state, place + 2 * LANES, fma(weight, shown_green, load(state, place + 2 * LANES)))
            store(state, place + 3 * LANES, fma(weight, shown_blue, load(state, place + 3 * LANES)))
            store(state, place + 4 * LANES, fma(weight, z, load(state, place + 4 * LANES)))
            place += ROW
            y = y + splat(f4(1.0))


@njit(cache=True, error_model="numpy")
def _blend_tile(records, pairs, left, top, columns, rows, state):
    # Blends the pairs of one tile, near to far, and returns how many it needed before all pixels were full.
    state[:] = f4(0.0)  # pixels outside the image are full
    for r in range(rows):
        for c in range(columns):
            state[c // LANES * STRIP_SIZE + r * ROW + c % LANES] = f4(1.0)
    for p in range(len(pairs)):
        _blend_pair(records[pairs[p, ID]], pairs[p], f4(left + 0.5), f4(top + 0.5), state)
        if p % CHECK_EVERY == CHECK_EVERY - 1 and _is_full(state):
            return p + 1
    return len(pairs)


@njit(parallel=True, cache=True, error_model="numpy")
def composite_forward(
    records, pairs, tile_starts, by_cost, workers, background, color, depth, transmittance, tile_ends
):
    # Writes color (H, W, 3), depth (H, W), transmittance (H, W), and tile_ends (L,): where each tile's list was left.
    height, width = depth.shape
    tiles_x = (width + TILE_WIDTH - 1) // TILE_WIDTH
    for worker in prange(workers):
        state = np.empty(STRIPS * STRIP_SIZE, f4)
        for index in range(worker, by_cost.size, workers):
            tile = by_cost[index]
            top, left = tile // tiles_x * TILE_HEIGHT, tile % tiles_x * TILE_WIDTH
            rows, columns = min(TILE_HEIGHT, height - top), min(TILE_WIDTH, width - left)
            start, end = tile_starts[tile], tile_starts[tile + 1]
            tile_ends[tile] = start + _blend_tile(records, pairs[start:end], left, top, columns, rows, state)
            for r in range(rows):
                for c in range(columns):
                    place = c // LANES * STRIP_SIZE + r * ROW + c % LANES
                    y, x, t = top + r, left + c, abs(state[place])
                    color[y, x, 0] = state[place + LANES] + t * background[0]
                    color[y, x, 1] = state[place + 2 * LANES] + t * background[1]
                    color[y, x, 2] = state[place + 3 * LANES] + t * background[2]
                    depth[y, x] = state[place + 4 * LANES]
                    transmittance[y, x] = t
