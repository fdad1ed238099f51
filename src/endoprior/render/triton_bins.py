"""Which Gaussians touch which tile, near to far, without leaving the device.

The image is cut into tiles TILE_WIDTH x TILE_HEIGHT. A pair is one Gaussian in one tile that its footprint (the ellipse
where alpha >= ALPHA_MIN) touches. Gaussians are ranked by depth once; each writes its pairs, rank after rank, into
*slots* of its own; a stable sort of the slots by tile then leaves every tile's pairs near to far. So 16 or 32 bits are
sorted per pair instead of tile and depth together, and the slots of one Gaussian stay side by side: its gradient is a
sum over them in a fixed order. Shared letters: `N` Gaussians, `P` pairs or room for them, `L` tiles.

How many pairs there are is known on the device only. Either the host waits for the number and makes room for exactly
that many, or (see `without_waiting`) it makes room for what earlier pictures needed.
"""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager
from contextvars import ContextVar
from dataclasses import dataclass
from math import log, log2

import torch
import triton
import triton.language as tl
from torch import Tensor

from .constants import ALPHA_MIN

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

# Columns of a record: all that compositing reads of one Gaussian, 48 bytes side by side. root = sqrt(a log2(e) / 2).
X, Y, ROOT, ROOT_K, M_LOG2, LOG2_OPACITY, RED, GREEN, BLUE, Z = (tl.constexpr(i) for i in range(10))
RECORD = tl.constexpr(12)
HALF_LOG2_E = tl.constexpr(0.5 / log(2))
LOG2_ALPHA_MIN = tl.constexpr(log2(ALPHA_MIN))
_WIDTH, _HEIGHT = tl.constexpr(TILE_WIDTH), tl.constexpr(TILE_HEIGHT)
_SAFE = tl.constexpr(0.01)  # log2 units: float32 rounding in the pixel kernels cannot draw outside of the footprint

FIRST_ROOM, ROOM_PER_GAUSSIAN, SPARE = 1 << 16, 16, 1.5
"""Pairs to make room for before any was counted: at least, and per Gaussian; and what is added to a number counted."""


@dataclass
class Room:
    """What one device remembers between pictures."""

    pairs: int
    """Most pairs that a picture had, as far as the host knows."""
    missed: Tensor
    """(1,) int64 on the device: most pairs of a picture that had no room for them since somebody looked, or 0."""


@dataclass(frozen=True)
class Bins:
    """The work list of one picture, on the device."""

    records: Tensor
    """(N, RECORD) by rank; rows of Gaussians that are not drawn are never set."""
    order: Tensor
    """(N,) int64 the Gaussian of each rank, near to far; those that are not drawn come last."""
    slot_ends: Tensor
    """(N,) int64 where the slots of each rank end; they begin where those of the rank before end."""
    slots: Tensor
    """(P,) int64 the slot of each pair, sorted by tile, then near to far."""
    ranks: Tensor
    """(P,) int32 the rank of each pair, in the same order."""
    tile_starts: Tensor
    """(L + 1,) int32 where the pairs of each tile begin."""


_waiting: ContextVar[bool] = ContextVar("waiting", default=True)
_rooms: dict[torch.device, Room] = {}


@contextmanager
def without_waiting() -> Iterator[None]:
    """Within, the host never waits for the device: for CUDA graphs, whose capture switches it on by itself.

    A picture that needs more room than there is lacks its farthest Gaussians. Ask `overflowed` before trusting one.
    """
    token = _waiting.set(False)
    try:
        yield
    finally:
        _waiting.reset(token)


def overflowed(device: torch.device | str) -> bool:
    """Whether a picture drawn without waiting lacked room since the last call; waits for the device.

    If so, the pictures (and gradients) since then are not to be trusted; draw them again, there is room now. A captured
    graph keeps the room it was captured with: capture it again.
    """
    room = _room(device)
    missed = int(room.missed)
    room.missed.zero_()
    room.pairs = max(room.pairs, missed)
    return missed > 0


def lacking(device: torch.device | str) -> Tensor:
    """() bool on the device: what `overflowed` would say, without waiting and without forgetting it."""
    return _room(device).missed[0] > 0


def _room(device: torch.device | str) -> Room:
    device = torch.device(device)
    if device.type == "cuda" and device.index is None:
        device = torch.device("cuda", torch.cuda.current_device())
    if device not in _rooms:
        if device.type == "cuda" and torch.cuda.is_current_stream_capturing():
            raise RuntimeError("no picture was drawn on this device yet. Draw one before a CUDA graph is captured.")
        _rooms[device] = Room(0, torch.zeros(1, dtype=torch.int64, device=device))
    return _rooms[device]


def _waits(device: torch.device) -> bool:
    return _waiting.get() and not (device.type == "cuda" and torch.cuda.is_current_stream_capturing())


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
    means2d, forms, z, colors, opacities, radii, order, num, width, height, records, counts, BLOCK: tl.constexpr
):
    """One program per BLOCK ranks. Writes records (N, RECORD) of the drawn Gaussians, and counts (N,) of their
    tiles."""
    rank = tl.program_id(0) * BLOCK + tl.arange(0, BLOCK)
    known = rank < num
    g = tl.load(order + rank, known, 0)
    drawn = known & (tl.load(radii + g, known, 0) > 0)
    x, y = tl.load(means2d + 2 * g, drawn, 0.0), tl.load(means2d + 2 * g + 1, drawn, 0.0)
    root = tl.sqrt(tl.load(forms + 3 * g, drawn, 1.0) * HALF_LOG2_E)
    root_k = root * tl.load(forms + 3 * g + 1, drawn, 0.0)
    m = tl.load(forms + 3 * g + 2, drawn, 1.0) * HALF_LOG2_E
    log2_opacity = tl.log2(tl.load(opacities + g, drawn, 1.0))
    row = records + rank * RECORD
    tl.store(row + X, x, drawn)
    tl.store(row + Y, y, drawn)
    tl.store(row + ROOT, root, drawn)
    tl.store(row + ROOT_K, root_k, drawn)
    tl.store(row + M_LOG2, m, drawn)
    tl.store(row + LOG2_OPACITY, log2_opacity, drawn)
    tl.store(row + RED, tl.load(colors + 3 * g, drawn, 0.0), drawn)
    tl.store(row + GREEN, tl.load(colors + 3 * g + 1, drawn, 0.0), drawn)
    tl.store(row + BLUE, tl.load(colors + 3 * g + 2, drawn, 0.0), drawn)
    tl.store(row + Z, tl.load(z + g, drawn, 0.0), drawn)
    ellipse = _ellipse(x, y, root, root_k, m, log2_opacity)
    first, last = _pixels(ellipse[1], -ellipse[7], ellipse[7], height)
    first_row, num_rows = _tiles(first, last, _HEIGHT)
    num_rows = tl.where(drawn, num_rows, 0)
    count = tl.zeros_like(num_rows)
    for i in range(0, tl.max(num_rows, 0)):
        _, num_columns = _columns(ellipse, first_row + i, width, height)
        count += tl.where(i < num_rows, num_columns, 0)
    tl.store(counts + rank, count, known)


@triton.jit(do_not_specialize=["num", "width", "height", "tiles_x", "capacity"])
def write_pairs(
    records, counts, slot_ends, num, width, height, tiles_x, capacity, missed, tiles, owners, BLOCK: tl.constexpr
):
    """One program per BLOCK ranks. Writes tile and rank of each pair into its slot, tiles (P,) and owners (P,), as far
    as there is room, and the number of pairs into missed (1,) if there was not enough and it is larger."""
    rank = tl.program_id(0) * BLOCK + tl.arange(0, BLOCK)
    known = rank < num
    count = tl.load(counts + rank, known, 0)
    end = tl.load(slot_ends + rank, known, 0)
    slot = end - count
    end = tl.minimum(end, capacity)
    row, drawn = records + rank * RECORD, count > 0
    x, y = tl.load(row + X, drawn, 0.0), tl.load(row + Y, drawn, 0.0)
    root, root_k = tl.load(row + ROOT, drawn, 1.0), tl.load(row + ROOT_K, drawn, 0.0)
    ellipse = _ellipse(x, y, root, root_k, tl.load(row + M_LOG2, drawn, 1.0), tl.load(row + LOG2_OPACITY, drawn, 0.0))
    first, last = _pixels(ellipse[1], -ellipse[7], ellipse[7], height)
    first_row, num_rows = _tiles(first, last, _HEIGHT)
    num_rows = tl.where(drawn, num_rows, 0)
    for i in range(0, tl.max(num_rows, 0)):
        column, num_columns = _columns(ellipse, first_row + i, width, height)
        num_columns = tl.where(i < num_rows, num_columns, 0)
        tile = (first_row + i) * tiles_x + column
        for j in range(0, tl.max(num_columns, 0)):
            fits = (j < num_columns) & (slot < end)
            tl.store(tiles + slot, (tile + j).to(tiles.dtype.element_ty), fits)
            tl.store(owners + slot, rank, fits)
            slot += (j < num_columns).to(tl.int64)
    if tl.program_id(0) == 0:
        total = tl.load(slot_ends + num - 1)
        tl.atomic_max(missed, tl.where(total > capacity, total, 0))


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


def build(
    means2d: Tensor,
    forms: Tensor,
    z: Tensor,
    colors: Tensor,
    opacities: Tensor,
    radii: Tensor,
    keys: Tensor,
    width: int,
    height: int,
) -> Bins:
    """Sort the Gaussians with `radii` > 0 by `keys` (ties by index) and list their tiles.

    Args:
        means2d, forms, z, colors, radii, keys: contiguous, from `project_forward`; opacities: (N,) contiguous.
    """
    num, device = len(keys), keys.device
    tiles_x, tiles_y = -(-width // TILE_WIDTH), -(-height // TILE_HEIGHT)
    num_tiles = tiles_x * tiles_y
    order = torch.sort(keys, stable=True).indices
    records = keys.new_empty((num, RECORD.value))
    counts = torch.empty(num, dtype=torch.int32, device=device)
    grid = (triton.cdiv(num, BLOCK),)  # an empty one is not launched
    # Without fused operations both kernels come to the same tiles, however they are compiled.
    options = {"BLOCK": BLOCK, "num_warps": 1, "enable_fp_fusion": False}
    gaussians = (means2d, forms, z, colors, opacities, radii, order)
    count_pairs[grid](*gaussians, num, width, height, records, counts, **options)
    slot_ends = counts.cumsum(0)
    room = _room(device)
    capacity = _capacity(room, slot_ends, num, device)
    dtype = torch.int16 if num_tiles < FEW_TILES else torch.int32
    tiles = torch.full((capacity,), num_tiles, dtype=dtype, device=device)  # a slot left free sorts to the end
    owners = torch.empty(capacity, dtype=torch.int32, device=device)
    write_pairs[grid](
        records, counts, slot_ends, num, width, height, tiles_x, capacity, room.missed, tiles, owners, **options
    )
    tiles, slots = torch.sort(tiles, stable=True)
    ranks, tile_starts = torch.empty_like(owners), owners.new_empty(num_tiles + 1)
    programs = triton.cdiv(max(capacity, num_tiles + 1), PAIR_BLOCK)
    index_pairs[(programs,)](
        tiles, slots, owners, capacity, num_tiles, ranks, tile_starts, BLOCK=PAIR_BLOCK, enable_fp_fusion=False
    )
    return Bins(records, order, slot_ends, slots, ranks, tile_starts)


def _capacity(room: Room, slot_ends: Tensor, num: int, device: torch.device) -> int:
    """How many pairs to make room for."""
    if not _waits(device):
        known = int(SPARE * room.pairs)
        return known or max(FIRST_ROOM, ROOM_PER_GAUSSIAN * num)
    pairs = int(slot_ends[-1]) if num else 0
    room.pairs = max(room.pairs, pairs)
    return max(pairs, 1)
