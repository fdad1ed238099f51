# pyright: reportCallIssue=false
"""Which Gaussians touch which tile, near to far.

The image is cut into tiles TILE_WIDTH x TILE_HEIGHT. A pair is one Gaussian in one tile, with the rows that its
footprint (the ellipse where alpha >= ALPHA_MIN) touches between the tile's left and right edge: other tiles and rows
are never visited, and nothing is lost because alpha is 0 there. Shared letters: `N` Gaussians, `P` pairs, `L` tiles.
"""

from __future__ import annotations

from dataclasses import dataclass
from math import log2

import numpy as np
from numba import njit, prange
from numpy.typing import NDArray

from ...compute.parallel_kernels import parallel_njit
from ...compute.simd import LANES, prefetch
from ..constants import ALPHA_MIN

STRIPS = 2
"""Strips of LANES px side by side in a tile; the rows that a Gaussian touches are known per strip."""
TILE_WIDTH, TILE_HEIGHT = STRIPS * LANES, 32
"""px."""
CHUNKS = 8
"""Runs of the depth order that are counted side by side; the result does not depend on it."""
AHEAD = 8
"""Gaussians, or pairs, between asking for the memory of one and using it: their order in memory is not that of depth,
so that no processor foresees it."""

# Columns of a record: all that compositing reads of one Gaussian, side by side in memory.
X, Y, ROOT, K, M_LOG2, LOG2_OPACITY, RED, GREEN, BLUE, Z, SLOPES = range(11)
RECORD_SIZE = 16
"""One cache line. From SLOPES on: the change of red, green, blue per px along x, then along y."""
HALF_LOG2_E = np.float32(0.5 * log2(np.e))
LOG2_ALPHA_MIN = log2(ALPHA_MIN)
DIGITS, DIGIT_BITS = 3, 11
"""z is sorted by its 32 bits, digit by digit, the lowest first (radix sort): ten times as fast as by comparison."""

# Columns of a pair.
ID, SLOT, FIRST_ROWS = range(3)
TILE = SLOT
"""While pairs are still listed Gaussian by Gaussian."""
PAIR_SIZE = FIRST_ROWS + 2 * STRIPS


@dataclass(frozen=True)
class Tiles:
    """The lists of one image."""

    records: NDArray[np.float32]
    """(N, RECORD_SIZE) see the columns above; only rows of visible Gaussians are set."""
    pairs: NDArray[np.int32]
    """(P, PAIR_SIZE) Gaussian, slot, and first and last + 1 row of each strip; sorted by tile, then near to far."""
    tile_starts: NDArray[np.int64]
    """(L + 1,) where the pairs of each tile begin."""
    slot_starts: NDArray[np.int64]
    """(N + 1,) slots are the same pairs counted Gaussian by Gaussian: where those of each Gaussian begin."""
    by_cost: NDArray[np.int64]
    """(L,) tiles, most rows to visit first."""


def build(
    means2d: NDArray[np.float32],
    conic_ldl: NDArray[np.float32],
    z: NDArray[np.float32],
    colors: NDArray[np.float32],
    color_slopes2d: NDArray[np.float32],
    opacities: NDArray[np.float32],
    radii: NDArray[np.int32],
    width: int,
    height: int,
) -> Tiles:
    """Sort the Gaussians with `radii` > 0 by z (ties by index) and list their tiles."""
    num, num_visible = len(z), np.count_nonzero(radii)
    tiles_x, tiles_y = -(-width // TILE_WIDTH), -(-height // TILE_HEIGHT)
    records, box_starts = np.empty((num, RECORD_SIZE), np.float32), np.zeros(num + 1, np.int64)
    gaussians = (means2d, conic_ldl, z, colors, color_slopes2d, opacities, radii)
    _write_records(*gaussians, width, height, records, box_starts)
    near_to_far = _near_to_far(z.view(np.uint32), radii, num_visible)

    np.cumsum(box_starts, out=box_starts)
    boxes = np.empty((box_starts[-1], PAIR_SIZE), np.int32)
    slot_starts = np.zeros(num + 1, np.int64)
    counts = np.zeros((CHUNKS, tiles_x * tiles_y), np.int64)
    costs = np.zeros((CHUNKS, tiles_x * tiles_y), np.int64)
    _list_pairs(records, near_to_far, width, height, tiles_x, box_starts, boxes, slot_starts, counts, costs)

    np.cumsum(slot_starts, out=slot_starts)
    tile_starts = np.zeros(tiles_x * tiles_y + 1, np.int64)
    np.cumsum(counts.sum(0), out=tile_starts[1:])
    cursors = tile_starts[:-1] + np.cumsum(counts, 0) - counts
    pairs = np.empty((tile_starts[-1], PAIR_SIZE), np.int32)
    _sort_pairs(near_to_far, box_starts, boxes, slot_starts, cursors, pairs)
    return Tiles(records, pairs, tile_starts, slot_starts, np.argsort(-costs.sum(0), kind="stable"))


@njit(cache=True)
def _near_to_far(z_bits, radii, num_visible):
    # Numbers of the visible Gaussians by z (its bits are monotone, as z is > 0), ties by number.
    order, sorted_order = np.empty(num_visible, np.int64), np.empty(num_visible, np.int64)
    starts, last_digit = np.zeros((DIGITS, 1 << DIGIT_BITS), np.int64), (1 << DIGIT_BITS) - 1
    found = 0
    for g in range(z_bits.size):
        if radii[g] > 0:
            order[found] = g
            found += 1
            for d in range(DIGITS):
                starts[d, (z_bits[g] >> np.uint32(DIGIT_BITS * d)) & last_digit] += 1
    for d in range(DIGITS):
        before = 0
        for value in range(last_digit + 1):
            count = starts[d, value]
            starts[d, value] = before
            before += count
        for g in order:
            digit = (z_bits[g] >> np.uint32(DIGIT_BITS * d)) & last_digit
            sorted_order[starts[d, digit]] = g
            starts[d, digit] += 1
        order, sorted_order = sorted_order, order
    return order


@njit(inline="always")
def _footprint(record):
    # The footprint is  square (dx + k dy)^2 + m dy^2 <= level.  Returns square, k, m, level in float64, the largest dy
    # (tip, found at dx = -k tip) and the largest dx (reach).
    # The level is widened a little, so that float32 rounding in the pixel kernels cannot reach outside of it.
    square, k, m = np.float64(record[ROOT]) ** 2, np.float64(record[K]), np.float64(record[M_LOG2])
    level = np.float64(record[LOG2_OPACITY]) - LOG2_ALPHA_MIN + 0.01
    tip = np.sqrt(level / m)
    return square, k, m, level, tip, tip * np.sqrt(k * k + m / square)


@njit(inline="always")
def _pixels(center, before, after, size):
    # First and last + 1 pixel of 0..size-1 with its center in [center + before, center + after], a hair more.
    first, last = max(np.ceil(center + before - 0.501), 0.0), min(np.floor(center + after - 0.499), size - 1.0)
    if not first <= last:
        return 0, 0
    return np.int64(first), np.int64(last) + 1


@parallel_njit(error_model="numpy")
def _write_records(means2d, conic_ldl, z, colors, color_slopes2d, opacities, radii, width, height, records, box_starts):
    # One iteration per Gaussian. Writes, if it is visible, its record and, at g + 1, how many tiles the box around it
    # touches: room enough for its pairs.
    for g in prange(z.size):
        if radii[g] > 0:
            records[g, X], records[g, Y] = means2d[g, 0], means2d[g, 1]
            records[g, ROOT] = np.sqrt(conic_ldl[g, 0] * HALF_LOG2_E)
            records[g, K] = conic_ldl[g, 1]
            records[g, M_LOG2] = conic_ldl[g, 2] * HALF_LOG2_E
            records[g, LOG2_OPACITY] = np.log2(opacities[g])
            records[g, RED], records[g, GREEN], records[g, BLUE] = colors[g, 0], colors[g, 1], colors[g, 2]
            records[g, Z] = z[g]
            for i in range(3):
                records[g, SLOPES + i] = color_slopes2d[g, 0, i]
                records[g, SLOPES + 3 + i] = color_slopes2d[g, 1, i]
            _, _, _, _, tip, reach = _footprint(records[g])
            left, right = _pixels(records[g, X], -reach, reach, width)
            top, bottom = _pixels(records[g, Y], -tip, tip, height)
            columns = (right + TILE_WIDTH - 1) // TILE_WIDTH - left // TILE_WIDTH
            box_starts[g + 1] = columns * ((bottom + TILE_HEIGHT - 1) // TILE_HEIGHT - top // TILE_HEIGHT)


@njit(inline="always")
def _write_spans(record, width, height, spans):
    # Fills spans[column, 0:2] with the first and last + 1 image row where the footprint meets each column of strips,
    # for the tiles that it touches, and returns its first and last + 1 tile column.
    square, k, m, level, tip, reach = _footprint(record)
    left, right = _pixels(record[X], -reach, reach, width)
    first_tile, end_tile = left // TILE_WIDTH, (right + TILE_WIDTH - 1) // TILE_WIDTH
    c = square * k * k + m
    for column in range(first_tile * STRIPS, end_tile * STRIPS):
        spans[column, 0] = spans[column, 1] = 0
        first_x = max(column * LANES + 0.5 - record[X], -reach)
        last_x = min(column * LANES + LANES - 0.5 - record[X], reach)
        if first_x <= last_x:
            # Its ends are the tips if they lie in the strip, else on the edge of the strip that is nearer to them.
            top, bottom = -tip, tip
            x = min(max(k * tip, first_x), last_x)
            if x != k * tip:
                top = -(np.sqrt(max(c * level - square * m * x * x, 0.0)) + square * k * x) / c
            x = min(max(-k * tip, first_x), last_x)
            if x != -k * tip:
                bottom = (np.sqrt(max(c * level - square * m * x * x, 0.0)) - square * k * x) / c
            spans[column, 0], spans[column, 1] = _pixels(record[Y], top, bottom, height)
    return first_tile, end_tile


@njit(inline="always")
def _tile_rows(spans, tile_column):
    # First and last + 1 tile row that any strip of the tile column needs.
    first, end = 2**30, 0
    for column in range(tile_column * STRIPS, (tile_column + 1) * STRIPS):
        if spans[column, 0] < spans[column, 1]:
            first, end = min(first, spans[column, 0]), max(end, spans[column, 1])
    return first // TILE_HEIGHT, (end + TILE_HEIGHT - 1) // TILE_HEIGHT


@parallel_njit(error_model="numpy")
def _list_pairs(records, near_to_far, width, height, tiles_x, box_starts, boxes, slot_starts, counts, costs):
    # One task per chunk of the depth order. Writes the pairs of each Gaussian into its box, with the tile in place of
    # the slot, and how many there are at slot_starts[g + 1]; adds up pairs and strip rows per (chunk, tile).
    for chunk in prange(CHUNKS):
        spans = np.empty((tiles_x * STRIPS, 2), np.int64)
        flat_records, flat_boxes = records.reshape(-1), boxes.reshape(-1)
        for rank in range(near_to_far.size * chunk // CHUNKS, near_to_far.size * (chunk + 1) // CHUNKS):
            g = near_to_far[rank]
            ahead = near_to_far[min(rank + AHEAD, near_to_far.size - 1)]
            prefetch(flat_records, ahead * RECORD_SIZE)
            prefetch(flat_boxes, box_starts[ahead] * PAIR_SIZE)
            place = box_starts[g]
            first_tile, end_tile = _write_spans(records[g], width, height, spans)
            for tile_column in range(first_tile, end_tile):
                first_row, end_row = _tile_rows(spans, tile_column)
                for tile_row in range(first_row, end_row):
                    tile, top = tile_row * tiles_x + tile_column, tile_row * TILE_HEIGHT
                    boxes[place, ID], boxes[place, TILE] = g, tile
                    for strip in range(STRIPS):
                        column = tile_column * STRIPS + strip
                        first = min(max(spans[column, 0] - top, 0), TILE_HEIGHT)
                        end = max(min(spans[column, 1] - top, TILE_HEIGHT), first)
                        boxes[place, FIRST_ROWS + 2 * strip], boxes[place, FIRST_ROWS + 2 * strip + 1] = first, end
                        costs[chunk, tile] += end - first
                    counts[chunk, tile] += 1
                    place += 1
            slot_starts[g + 1] = place - box_starts[g]


@parallel_njit(error_model="numpy")
def _sort_pairs(near_to_far, box_starts, boxes, slot_starts, cursors, pairs):
    # One task per chunk, as above; cursors (CHUNKS, L) say where each chunk's next pair of a tile goes in `pairs`.
    for chunk in prange(CHUNKS):
        flat_boxes = boxes.reshape(-1)
        for rank in range(near_to_far.size * chunk // CHUNKS, near_to_far.size * (chunk + 1) // CHUNKS):
            g = near_to_far[rank]
            prefetch(flat_boxes, box_starts[near_to_far[min(rank + AHEAD, near_to_far.size - 1)]] * PAIR_SIZE)
            for i in range(slot_starts[g + 1] - slot_starts[g]):
                pair = boxes[box_starts[g] + i]
                place = cursors[chunk, pair[TILE]]
                cursors[chunk, pair[TILE]] = place + 1
                pairs[place, ID], pairs[place, SLOT] = g, slot_starts[g] + i
                for j in range(FIRST_ROWS, PAIR_SIZE):
                    pairs[place, j] = pair[j]
