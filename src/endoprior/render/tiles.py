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

from .constants import ALPHA_MIN
from .simd import LANES

STRIPS = 2
"""Strips of LANES px side by side in a tile; the rows that a Gaussian touches are known per strip."""
TILE_WIDTH, TILE_HEIGHT = STRIPS * LANES, 32
"""px."""
CHUNKS = 8
"""Runs of the depth order that are counted side by side; the result does not depend on it."""

# Columns of a record: all that compositing reads of one Gaussian, side by side in memory.
X, Y, ROOT, K, M_LOG2, LOG2_OPACITY, RED, GREEN, BLUE, Z = range(10)
RECORD_SIZE = 12
HALF_LOG2_E = np.float32(0.5 * log2(np.e))

LOG2_ALPHA_MIN = log2(ALPHA_MIN)

# Columns of a pair.
ID, SLOT, FIRST_ROWS = range(3)
PAIR_SIZE = FIRST_ROWS + 2 * STRIPS


@dataclass(frozen=True)
class Tiles:
    """The work list of one picture."""

    records: NDArray[np.float32]
    """(N, RECORD_SIZE) see the columns above; only rows of drawn Gaussians are set."""
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
    row_forms: NDArray[np.float32],
    z: NDArray[np.float32],
    colors: NDArray[np.float32],
    opacities: NDArray[np.float32],
    radii: NDArray[np.int32],
    width: int,
    height: int,
) -> Tiles:
    """Sort the Gaussians with `radii` > 0 by z (ties by index) and list their tiles."""
    records = np.empty((len(z), RECORD_SIZE), np.float32)
    keys = np.empty(len(z), np.int64)
    visible = _write_records(means2d, row_forms, z, z.view(np.int32), colors, opacities, radii, records, keys)
    near_to_far = np.sort(keys[:visible]) & 0xFFFFFFFF
    tiles_x, tiles_y = -(-width // TILE_WIDTH), -(-height // TILE_HEIGHT)
    slot_starts = np.zeros(len(z) + 1, np.int64)
    counts = np.zeros((CHUNKS, tiles_x * tiles_y), np.int64)
    costs = np.zeros((CHUNKS, tiles_x * tiles_y), np.int64)
    _count(records, near_to_far, width, height, tiles_x, slot_starts, counts, costs)
    np.cumsum(slot_starts, out=slot_starts)
    tile_starts = np.zeros(tiles_x * tiles_y + 1, np.int64)
    np.cumsum(counts.sum(0), out=tile_starts[1:])
    cursors = tile_starts[:-1] + np.cumsum(counts, 0) - counts
    pairs = np.empty((tile_starts[-1], PAIR_SIZE), np.int32)
    _fill(records, near_to_far, width, height, tiles_x, slot_starts, cursors, pairs)
    return Tiles(records, pairs, tile_starts, slot_starts, np.argsort(-costs.sum(0), kind="stable"))


@njit(cache=True, error_model="numpy")
def _write_records(means2d, row_forms, z, z_bits, colors, opacities, radii, records, keys):
    # One thread. Writes the record of each visible Gaussian and its sort key: the bits of z (monotone as z > 0), then
    # id.
    visible = 0
    for g in range(z.size):
        if radii[g] > 0:
            records[g, X], records[g, Y] = means2d[g, 0], means2d[g, 1]
            records[g, ROOT] = np.sqrt(row_forms[g, 0] * HALF_LOG2_E)
            records[g, K] = row_forms[g, 1]
            records[g, M_LOG2] = row_forms[g, 2] * HALF_LOG2_E
            records[g, LOG2_OPACITY] = np.log2(opacities[g])
            records[g, RED], records[g, GREEN], records[g, BLUE] = colors[g, 0], colors[g, 1], colors[g, 2]
            records[g, Z] = z[g]
            keys[visible] = (np.int64(z_bits[g]) << 32) | g
            visible += 1
    return visible


@njit(inline="always")
def _spans(record, width, height, spans):
    # Fills spans[column, 0:2] with the first and last + 1 image row where the footprint
    # square (dx + k dy)^2 + m dy^2 <= level  meets each column of strips, and returns its first and last + 1 tile
    # column. The level is widened a little, so that float32 rounding in the pixel kernels cannot draw outside the
    # listed rows.
    x, y, k, m = np.float64(record[X]), np.float64(record[Y]), np.float64(record[K]), np.float64(record[M_LOG2])
    square = np.float64(record[ROOT]) ** 2
    level = np.float64(record[LOG2_OPACITY]) - LOG2_ALPHA_MIN + 0.01
    c = square * k * k + m
    tip = np.sqrt(level / m)  # largest dy of the footprint, found at dx = -k tip
    reach = tip * np.sqrt(c / square)  # largest dx
    first = max(np.ceil(x - reach - 0.501), 0.0)
    last = min(np.floor(x + reach - 0.499), width - 1.0)
    if not first <= last:
        return 0, 0
    first_column, end_column = np.int64(first) // LANES, np.int64(last) // LANES + 1
    first_tile, end_tile = first_column // STRIPS, (end_column + STRIPS - 1) // STRIPS
    inverse_c = 1.0 / c
    for column in range(first_tile * STRIPS, end_tile * STRIPS):
        spans[column, 0] = spans[column, 1] = 0
        if column < first_column or column >= end_column:
            continue
        # Bottom and top are the tips if they lie in the strip, else on the edge of the strip that is nearer to them.
        left, right = max(column * LANES + 0.5 - x, -reach), min(column * LANES + LANES - 0.5 - x, reach)
        bottom = tip
        at = min(max(-k * tip, left), right)
        if at != -k * tip:
            bottom = inverse_c * (np.sqrt(max(c * level - square * m * at * at, 0.0)) - square * k * at)
        top = -tip
        at = min(max(k * tip, left), right)
        if at != k * tip:
            top = -inverse_c * (np.sqrt(max(c * level - square * m * at * at, 0.0)) + square * k * at)
        first_row, last_row = max(np.ceil(y + top - 0.501), 0.0), min(np.floor(y + bottom - 0.499), height - 1.0)
        if first_row <= last_row:
            spans[column, 0], spans[column, 1] = np.int64(first_row), np.int64(last_row) + 1
    return first_tile, end_tile


@njit(inline="always")
def _tile_rows(spans, tile_column):
    # First and last + 1 tile row that any strip of the tile column needs.
    first, end = 2**30, 0
    for column in range(tile_column * STRIPS, (tile_column + 1) * STRIPS):
        if spans[column, 0] < spans[column, 1]:
            first, end = min(first, spans[column, 0]), max(end, spans[column, 1])
    return first // TILE_HEIGHT, (end + TILE_HEIGHT - 1) // TILE_HEIGHT


@njit(parallel=True, cache=True, error_model="numpy")
def _count(records, near_to_far, width, height, tiles_x, slot_starts, counts, costs):
    # One task per chunk of the depth order. Adds up pairs per Gaussian (at slot_starts[g + 1]), and pairs and strip
    # rows per (chunk, tile).
    for chunk in prange(CHUNKS):
        spans = np.empty((tiles_x * STRIPS, 2), np.int64)
        for rank in range(near_to_far.size * chunk // CHUNKS, near_to_far.size * (chunk + 1) // CHUNKS):
            g = near_to_far[rank]
            first_tile, end_tile = _spans(records[g], width, height, spans)
            for tile_column in range(first_tile, end_tile):
                first_row, end_row = _tile_rows(spans, tile_column)
                for tile_row in range(first_row, end_row):
                    tile = tile_row * tiles_x + tile_column
                    counts[chunk, tile] += 1
                    slot_starts[g + 1] += 1
                    for column in range(tile_column * STRIPS, (tile_column + 1) * STRIPS):
                        begin = max(spans[column, 0], tile_row * TILE_HEIGHT)
                        costs[chunk, tile] += max(min(spans[column, 1], (tile_row + 1) * TILE_HEIGHT) - begin, 0)


@njit(parallel=True, cache=True, error_model="numpy")
def _fill(records, near_to_far, width, height, tiles_x, slot_starts, cursors, pairs):
    # The same walk as `_count`; cursors (CHUNKS, L) say where each chunk's next pair of a tile goes.
    for chunk in prange(CHUNKS):
        spans = np.empty((tiles_x * STRIPS, 2), np.int64)
        for rank in range(near_to_far.size * chunk // CHUNKS, near_to_far.size * (chunk + 1) // CHUNKS):
            g = near_to_far[rank]
            slot = slot_starts[g]
            first_tile, end_tile = _spans(records[g], width, height, spans)
            for tile_column in range(first_tile, end_tile):
                first_row, end_row = _tile_rows(spans, tile_column)
                for tile_row in range(first_row, end_row):
                    tile = tile_row * tiles_x + tile_column
                    pair = pairs[cursors[chunk, tile]]
                    cursors[chunk, tile] += 1
                    pair[ID], pair[SLOT] = g, slot
                    slot += 1
                    for strip in range(STRIPS):
                        column = tile_column * STRIPS + strip
                        begin = max(spans[column, 0] - tile_row * TILE_HEIGHT, 0)
                        pair[FIRST_ROWS + 2 * strip] = min(begin, TILE_HEIGHT)
                        end = min(spans[column, 1] - tile_row * TILE_HEIGHT, TILE_HEIGHT)
                        pair[FIRST_ROWS + 2 * strip + 1] = max(end, 0)
