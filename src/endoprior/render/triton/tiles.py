# pyright: reportGeneralTypeIssues=false, reportArgumentType=false
"""Which Gaussians touch which tile, near to far, on the device.

The image is cut into tiles TILE_WIDTH x TILE_HEIGHT. A pair is one Gaussian in one tile that its footprint (the ellipse
where alpha >= ALPHA_MIN) touches. Gaussians are ranked by depth once; each writes its pairs, rank after rank, into
*slots* of its own; a stable sort of the slots by tile then leaves every tile's pairs near to far. So 16 or 32 bits are
sorted per pair instead of tile and depth together, and the slots of one Gaussian stay side by side: its gradient is a
sum over them in a fixed order. Once per image the host waits for the number of pairs.
Shared letters: `N` Gaussians, `P` pairs, `L` tiles.
"""

from __future__ import annotations

from dataclasses import dataclass
from math import log, log2

import torch
import triton
import triton.language as tl
from torch import Tensor

from ..constants import ALPHA_MIN
from .launch import launch, load_three, store_three

TILE_WIDTH, ROWS_PER_LANE = 16, 4
"""px. A tile is the work of one warp: lane 2c + r holds rows r, r + 2, ... of column c."""
TILE_HEIGHT = 2 * ROWS_PER_LANE
"""px."""
BLOCK = 32
"""Gaussians per program: one warp, so that a Gaussian on many tiles keeps few others waiting."""
PAIR_BLOCK = 256
"""Pairs, and tiles, per program of `index_pairs`."""
FEW_TILES = 1 << 15
"""Fewer tiles are numbered in 16 bits: half the passes of the sort."""

# Columns of a record: all that compositing reads of one Gaussian, 64 bytes side by side. root = sqrt(a log2(e) / 2);
# from SLOPES on: the change of red, green, blue per px along x, then along y.
X, Y, ROOT, ROOT_K, M_LOG2, LOG2_OPACITY, RED, GREEN, BLUE, Z, SLOPES = (tl.constexpr(i) for i in range(11))
RECORD = tl.constexpr(16)
HALF_LOG2_E = tl.constexpr(0.5 / log(2))
LOG2_ALPHA_MIN = tl.constexpr(log2(ALPHA_MIN))
_WIDTH, _HEIGHT = tl.constexpr(TILE_WIDTH), tl.constexpr(TILE_HEIGHT)
_SAFE = tl.constexpr(0.01)  # log2 units: float32 rounding in the pixel kernels cannot reach outside of the footprint


@dataclass(frozen=True)
class Tiles:
    """The lists of one image, on the device."""

    records: Tensor
    """(N, RECORD) by rank; only rows of visible Gaussians are set."""
    order: Tensor
    """(N,) int64 the Gaussian of each rank, near to far; those that are not visible come last."""
    slot_ends: Tensor
    """(N,) int64 where the slots of each rank end; they begin where those of the rank before end."""
    slots: Tensor
    """(P,) int64 the slot of each pair, sorted by tile, then near to far."""
    ranks: Tensor
    """(P,) int32 the rank of each pair, in the same order."""
    tile_starts: Tensor
    """(L + 1,) int32 where the pairs of each tile begin."""


@triton.jit
def _pixels(center, before, after, size):
    # First and last pixel of 0..size-1 with its center in [center + before, center + after], a hair more.
    first = tl.maximum(tl.ceil(center + before - 0.501), 0.0)
    last = tl.minimum(tl.floor(center + after - 0.499), size - 1.0)
    return first, last


@triton.jit
def _tiles(first, last, SIDE: tl.constexpr):
    # First tile, and how many, of a run of pixels; none where the run is empty or not a number.
    some = first <= last
    first_tile = tl.where(some, first, 0.0).to(tl.int32) // SIDE
    last_tile = tl.where(some, last, 0.0).to(tl.int32) // SIDE
    return first_tile, tl.where(some, last_tile - first_tile + 1, 0)


@triton.jit
def _ellipse(x, y, root, root_k, m, log2_opacity):
    # The footprint is (root dy + root_k dx)^2 + m dx^2 <= level, in float64.
    x, y, root, root_k = x.to(tl.float64), y.to(tl.float64), root.to(tl.float64), root_k.to(tl.float64)
    m, level = m.to(tl.float64), log2_opacity.to(tl.float64) - LOG2_ALPHA_MIN + _SAFE
    # Along y it reaches sqrt(both level / (root^2 m)), both = root_k^2 + m; along x sqrt(level / m), at dy = -tip.
    both = root_k * root_k + m
    reach_y = tl.sqrt(both * level / m) / root
    tip = tl.sqrt(level / m) * root_k / root
    return x, y, root, root_k, m, level, both, reach_y, tip


@triton.jit
def _columns(ellipse, tile_row, width, height):
    # First tile column and how many that the footprint touches between the first and the last pixel of a tile row.
    x, y, root, root_k, m, level, both, reach_y, tip = ellipse
    top = tl.maximum(tile_row * _HEIGHT + 0.5 - y, -reach_y)
    bottom = tl.minimum(tl.minimum(tile_row * _HEIGHT + _HEIGHT, height) - 0.5 - y, reach_y)
    # The widest places are the tips, if they lie in the row, else on the edge that is nearer to them.
    dy = root * tl.minimum(tl.maximum(tip, top), bottom)
    left = (-root_k * dy - tl.sqrt(tl.maximum(both * level - m * dy * dy, 0.0))) / both
    dy = root * tl.minimum(tl.maximum(-tip, top), bottom)
    right = (-root_k * dy + tl.sqrt(tl.maximum(both * level - m * dy * dy, 0.0))) / both
    first, last = _pixels(x, left, right, width)
    return _tiles(first, tl.where(top <= bottom, last, -1.0), _WIDTH)


@triton.jit(do_not_specialize=["num", "width", "height"])
def count_pairs(
    means2d, conic_ldl, z, colors, color_slopes2d, opacities, radii, order, num, width, height, records, counts,
    BLOCK: tl.constexpr,
):  # fmt: skip
    """One program per BLOCK ranks. Writes records (N, RECORD) of the visible Gaussians, and counts (N,) of their
    tiles."""
    rank = tl.program_id(0) * BLOCK + tl.arange(0, BLOCK)
    known = rank < num
    g = tl.load(order + rank, known, 0)
    visible = known & (tl.load(radii + g, known, 0) > 0)
    x, y = tl.load(means2d + 2 * g, visible, 0.0), tl.load(means2d + 2 * g + 1, visible, 0.0)
    red, green, blue = load_three(colors + 3 * g, visible)
    root = tl.sqrt(tl.load(conic_ldl + 3 * g, visible, 1.0) * HALF_LOG2_E)
    root_k = root * tl.load(conic_ldl + 3 * g + 1, visible, 0.0)
    m = tl.load(conic_ldl + 3 * g + 2, visible, 1.0) * HALF_LOG2_E
    log2_opacity = tl.log2(tl.load(opacities + g, visible, 1.0))
    row = records + rank * RECORD
    store_three(row + X, x, y, root, visible)
    store_three(row + ROOT_K, root_k, m, log2_opacity, visible)
    store_three(row + RED, red, green, blue, visible)
    tl.store(row + Z, tl.load(z + g, visible, 0.0), visible)
    for i in tl.static_range(6):
        tl.store(row + SLOPES + i, tl.load(color_slopes2d + 6 * g + i, visible, 0.0), visible)
    ellipse = _ellipse(x, y, root, root_k, m, log2_opacity)
    first, last = _pixels(ellipse[1], -ellipse[7], ellipse[7], height)
    first_row, num_rows = _tiles(first, last, _HEIGHT)
    num_rows = tl.where(visible, num_rows, 0)
    count = tl.zeros_like(num_rows)
    for i in range(0, tl.max(num_rows, 0)):
        _, num_columns = _columns(ellipse, first_row + i, width, height)
        count += tl.where(i < num_rows, num_columns, 0)
    tl.store(counts + rank, count, known)


@triton.jit(do_not_specialize=["num", "width", "height", "tiles_x"])
def write_pairs(records, counts, slot_ends, num, width, height, tiles_x, tiles, owners, BLOCK: tl.constexpr):
    """One program per BLOCK ranks. Writes tile and rank of each pair into its slot, tiles (P,) and owners (P,)."""
    rank = tl.program_id(0) * BLOCK + tl.arange(0, BLOCK)
    known = rank < num
    count = tl.load(counts + rank, known, 0)
    slot = tl.load(slot_ends + rank, known, 0) - count
    row, visible = records + rank * RECORD, count > 0
    x, y = tl.load(row + X, visible, 0.0), tl.load(row + Y, visible, 0.0)
    root, root_k = tl.load(row + ROOT, visible, 1.0), tl.load(row + ROOT_K, visible, 0.0)
    m, log2_opacity = tl.load(row + M_LOG2, visible, 1.0), tl.load(row + LOG2_OPACITY, visible, 0.0)
    ellipse = _ellipse(x, y, root, root_k, m, log2_opacity)
    first, last = _pixels(ellipse[1], -ellipse[7], ellipse[7], height)
    first_row, num_rows = _tiles(first, last, _HEIGHT)
    num_rows = tl.where(visible, num_rows, 0)
    for i in range(0, tl.max(num_rows, 0)):
        column, num_columns = _columns(ellipse, first_row + i, width, height)
        num_columns = tl.where(i < num_rows, num_columns, 0)
        tile = (first_row + i) * tiles_x + column
        for j in range(0, tl.max(num_columns, 0)):
            listed = j < num_columns
            tl.store(tiles + slot, (tile + j).to(tiles.dtype.element_ty), listed)
            tl.store(owners + slot, rank, listed)
            slot += listed.to(tl.int64)


@triton.jit(do_not_specialize=["num_pairs", "num_tiles"])
def index_pairs(tiles, slots, owners, num_pairs, num_tiles, ranks, tile_starts, BLOCK: tl.constexpr):
    """Programs of BLOCK pairs and BLOCK tiles. Writes ranks (P,), the owners in the order of slots, and tile_starts
    (L + 1,): how many of the sorted tiles come before each."""
    pair = tl.program_id(0) * BLOCK + tl.arange(0, BLOCK)
    known = pair < num_pairs
    tl.store(ranks + pair, tl.load(owners + tl.load(slots + pair, known, 0), known, 0), known)
    if tl.program_id(0) * BLOCK <= num_tiles:
        tile = pair
        low = tl.zeros_like(tile)
        high = low + num_pairs
        for _ in range(0, 32):  # halves what is left of up to 2^31 pairs
            middle = low + (high - low) // 2
            before = (low < high) & (tl.load(tiles + middle, low < high, 0).to(tl.int32) < tile)
            low = tl.where(before, middle + 1, low)
            high = tl.where(before, high, middle)
        tl.store(tile_starts + tile, low, tile <= num_tiles)


def columns(width: int) -> int:
    """Tiles side by side in an image of that width, px."""
    return -(-width // TILE_WIDTH)


def build(gaussians: tuple[Tensor, ...], radii: Tensor, size: tuple[int, int]) -> Tiles:
    """Sort the Gaussians with `radii` > 0 by z (ties by index) and list their tiles: see `autograd.Kernels`."""
    (width, height), z = size, gaussians[2]
    num, device = len(z), z.device
    tiles_x = columns(width)
    num_tiles = tiles_x * -(-height // TILE_HEIGHT)
    order = torch.sort(torch.where(radii > 0, z, torch.inf), stable=True).indices
    records = z.new_empty((num, RECORD.value))
    counts = torch.empty(num, dtype=torch.int32, device=device)
    programs = triton.cdiv(num, BLOCK)
    # Without fused operations both kernels come to the same tiles, however they are compiled.
    options = {"BLOCK": BLOCK, "num_warps": 1, "enable_fp_fusion": False}
    launch(count_pairs, programs, *gaussians, radii, order, num, width, height, records, counts, **options)
    slot_ends = counts.cumsum(0)
    num_pairs = read_num_pairs(slot_ends)
    dtype = torch.int16 if num_tiles < FEW_TILES else torch.int32
    tiles = torch.empty(num_pairs, dtype=dtype, device=device)
    owners = torch.empty(num_pairs, dtype=torch.int32, device=device)
    launch(write_pairs, programs, records, counts, slot_ends, num, width, height, tiles_x, tiles, owners, **options)
    tiles, slots = torch.sort(tiles, stable=True)
    ranks, tile_starts = torch.empty_like(owners), owners.new_empty(num_tiles + 1)
    programs = triton.cdiv(max(num_pairs, num_tiles + 1), PAIR_BLOCK)
    options = {"BLOCK": PAIR_BLOCK, "enable_fp_fusion": False}
    launch(index_pairs, programs, tiles, slots, owners, num_pairs, num_tiles, ranks, tile_starts, **options)
    return Tiles(records, order, slot_ends, slots, ranks, tile_starts)


def read_num_pairs(slot_ends: Tensor) -> int:
    """The number of pairs of a Gaussian and a tile, the last of the (N,) `slot_ends`; the host waits for the device."""
    return int(slot_ends[-1]) if len(slot_ends) else 0
