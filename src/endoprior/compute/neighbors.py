"""Exact nearest neighbors of every point of a cloud among the others, on the CPU.

Points are sorted along a Morton curve and cut into blocks of LANES; eight blocks make a group, eight groups a group of
the next level, and so on. All points of a block search side by side, one per lane: whatever lies in boxes no farther
than their worst neighbor so far is looked at. The order along the curve decides how fast that is, never the result.

Shared letters: `P` points, `K` neighbors, `B` blocks, `G` groups of all levels together. Shared arrays (C-contiguous,
trusted):

- `blocks` flat, B x (x, y, z, index) x LANES float64: the points; after the last one, infinity with index P.
- `boxes` flat, G x (low x, y, z, high x, y, z, least index) x LANES float64: the boxes of a group's eight members;
  those that do not exist are inside out. Group g of a level has members 8 g to 8 g + 7 of the level below, where the
  lowest groups have blocks. `level_start` is the first group of each level, lowest first; the highest has one.

A candidate comes before another if it is nearer, or as near with a smaller index: a total order, so the result does not
depend on the number of threads. The distance between boxes is computed like that between points, and each operation
rounds monotonically, so it is at most the computed distance of any two points in them: nothing is lost to rounding.
"""

from __future__ import annotations

import numpy as np
from numba import njit, prange
from numpy.typing import NDArray

from .float64_lanes import LANES, equal, larger, largest, less, load, pick, splat, store
from .morton import curve_order

MAX_COORDINATE = 1e150
"""mm; squares of larger ones overflow."""

_BLOCK = 4 * LANES
_GROUP = 7 * LANES
_BLOCKS_PER_TASK = 32


def nearest(points: NDArray, k: int) -> tuple[NDArray[np.intp], NDArray[np.float64]]:
    """The `k` nearest other points of each point, nearest first, equally near ones by index.

    Args:
        points: (P, 3) float32 or float64, C-contiguous, magnitudes up to `MAX_COORDINATE`; 0 < k < P.
    Returns:
        (P, k) indices and (P, k) distances, computed in float64.
    """
    num = len(points)
    num_blocks = -(-num // LANES)
    counts = [-(-num_blocks // LANES)]
    while counts[-1] > 1:
        counts.append(-(-counts[-1] // LANES))
    level_start = np.cumsum([0, *counts])[:-1]
    blocks, boxes = np.empty(num_blocks * _BLOCK), np.empty(sum(counts) * _GROUP)
    _fill_blocks(points, curve_order(points), blocks, boxes)
    _fill_groups(num, level_start, boxes)
    indices, distances = np.empty((num, k), np.intp), np.empty((num, k))
    _search(num, blocks, boxes, level_start, indices, distances)
    return indices, distances


@njit(cache=True, inline="always")
def _member(i):
    # Where the box of member i of a level begins, counted from the level's first group; its numbers are LANES apart.
    return i // LANES * _GROUP + i % LANES


@njit(parallel=True, cache=True, error_model="numpy")
def _fill_blocks(points, order, blocks, boxes):
    # One task per place of the lowest level: writes the block, if it exists, and its box.
    num = len(points)
    num_blocks = len(blocks) // _BLOCK
    for b in prange((num_blocks + LANES - 1) // LANES * LANES):
        low, high, least = np.full(3, np.inf), np.full(3, -np.inf), num
        if b < num_blocks:
            for lane in range(LANES):
                place = b * LANES + lane
                i = order[place] if place < num else num
                blocks[b * _BLOCK + 3 * LANES + lane] = i
                least = min(least, i)
                for a in range(3):
                    x = np.float64(points[i, a]) if i < num else np.inf
                    blocks[b * _BLOCK + a * LANES + lane] = x
                    if i < num:
                        low[a], high[a] = min(low[a], x), max(high[a], x)
        for a in range(3):
            boxes[_member(b) + a * LANES], boxes[_member(b) + (3 + a) * LANES] = low[a], high[a]
        boxes[_member(b) + 6 * LANES] = least


@njit(cache=True, error_model="numpy")
def _fill_groups(num, level_start, boxes):
    # Writes the boxes of all levels but the lowest, from below.
    for level in range(1, len(level_start)):
        below = level_start[level - 1] * _GROUP
        first, num_members = level_start[level] * _GROUP, level_start[level] - level_start[level - 1]
        for i in range((num_members + LANES - 1) // LANES * LANES):
            target = first + _member(i)
            for a in range(7):
                value = -np.inf if 3 <= a < 6 else (np.inf if a < 3 else np.float64(num))
                if i < num_members:
                    for lane in range(LANES):
                        x = boxes[below + i * _GROUP + a * LANES + lane]
                        value = max(value, x) if 3 <= a < 6 else min(value, x)
                boxes[target + a * LANES] = value


@njit(cache=True, forceinline=True)
def _before(distance, index, other_distance, other_index):
    # Lanes where the first candidate comes before the second.
    return less(distance, other_distance) | (equal(distance, other_distance) & less(index, other_index))


@njit(cache=True, forceinline=True)
def _square(x, y, z):
    return x * x + y * y + z * z


@njit(cache=True)
def _look_at(block, x, y, z, own, k, blocks, best):
    # Offers the points of a block to the lanes' lists: best flat, K rows of squared distances, then K of indices.
    # x, y, z, own are the searching points and their indices. Whether a list changed.
    last, changed = (k - 1) * LANES, False
    worst, worst_index = load(best, last), load(best, k * LANES + last)
    first = np.uintp(block * _BLOCK)  # unsigned: spares the compiler the check for negative indices
    for place in range(first, first + np.uintp(LANES)):
        distance = _square(
            x - splat(blocks[place]), y - splat(blocks[place + np.uintp(LANES)]),
            z - splat(blocks[place + np.uintp(2 * LANES)]),
        )  # fmt: skip
        index = splat(blocks[place + np.uintp(3 * LANES)])
        distance = pick(equal(index, own), splat(np.inf), distance)
        enters = _before(distance, index, worst, worst_index)
        if enters == 0:
            continue
        changed = True
        for row in range(last, 0, -LANES):
            up, up_index = load(best, row - LANES), load(best, k * LANES + row - LANES)
            passes = _before(distance, index, up, up_index)
            store(best, row, pick(enters, pick(passes, up, distance), load(best, row)))
            store(best, k * LANES + row, pick(enters, pick(passes, up_index, index), load(best, k * LANES + row)))
            enters = passes
        store(best, 0, pick(enters, distance, load(best, 0)))
        store(best, k * LANES, pick(enters, index, load(best, k * LANES)))
        worst, worst_index = load(best, last), load(best, k * LANES + last)
    return changed


@njit(cache=True, forceinline=True)
def _apart(low, high, group, a, boxes):
    # Distance along axis a between the interval low..high and the eight members of a group.
    start = group * _GROUP + a * LANES
    gap = larger(load(boxes, start) - splat(high), splat(low) - load(boxes, start + 3 * LANES))
    return larger(gap, splat(0.0))


@njit(parallel=True, cache=True, error_model="numpy")
def _search(num, blocks, boxes, level_start, indices, distances):
    # One task per run of blocks; writes the rows of its points.
    k, num_blocks = indices.shape[1], len(blocks) // _BLOCK
    for task in prange((num_blocks + _BLOCKS_PER_TASK - 1) // _BLOCKS_PER_TASK):
        best = np.empty(2 * k * LANES)
        waiting = np.empty((len(level_start) * LANES, 2), np.int64)
        for block in range(task * _BLOCKS_PER_TASK, min(num_blocks, (task + 1) * _BLOCKS_PER_TASK)):
            _search_block(block, num, k, blocks, boxes, level_start, best, waiting)
            for lane in range(min(LANES, num - block * LANES)):
                i = np.int64(blocks[block * _BLOCK + 3 * LANES + lane])
                for s in range(k):
                    indices[i, s] = np.int64(best[(k + s) * LANES + lane])
                    distances[i, s] = np.sqrt(best[s * LANES + lane])


@njit(cache=True, error_model="numpy")
def _search_block(block, num, k, blocks, boxes, level_start, best, waiting):
    # Fills best for the points of one block. `waiting` holds the groups still to visit, as (level, group).
    num_blocks, size = len(blocks) // _BLOCK, min(LANES, num - block * LANES)
    for i in range(k * LANES):
        best[i] = np.inf if i % LANES < size else -1.0  # lanes without a point take nothing
        best[k * LANES + i] = num
    start, last = block * _BLOCK, (k - 1) * LANES
    x, y, z = load(blocks, start), load(blocks, start + LANES), load(blocks, start + 2 * LANES)
    own = load(blocks, start + 3 * LANES)
    first, end = max(block - 1, 0), min(block + 2, num_blocks)
    for other in range(first, end):
        _look_at(other, x, y, z, own, k, blocks, best)
    worst, worst_index = largest(load(best, last)), largest(load(best, k * LANES + last))
    box = _member(block)
    count, waiting[0, 0], waiting[0, 1] = 1, len(level_start) - 1, 0
    while count > 0:
        count -= 1
        level, group = waiting[count, 0], waiting[count, 1]
        g = level_start[level] + group
        gap = _square(
            _apart(boxes[box], boxes[box + 3 * LANES], g, 0, boxes),
            _apart(boxes[box + LANES], boxes[box + 4 * LANES], g, 1, boxes),
            _apart(boxes[box + 2 * LANES], boxes[box + 5 * LANES], g, 2, boxes),
        )
        least = load(boxes, g * _GROUP + 6 * LANES)
        visit = np.int64(_before(gap, least, splat(worst), splat(worst_index)))
        for place in range(LANES):
            lane = place if level == 0 else LANES - 1 - place  # the first goes on top: many ties end after few visits
            if not (visit >> lane) & 1:
                continue
            member = group * LANES + lane
            if level > 0:
                waiting[count, 0], waiting[count, 1] = level - 1, member
                count += 1
            elif not first <= member < end:
                if _look_at(member, x, y, z, own, k, blocks, best):
                    worst, worst_index = largest(load(best, last)), largest(load(best, k * LANES + last))
