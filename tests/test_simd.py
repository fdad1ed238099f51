"""The vector type: each operation against NumPy, lane by lane."""

from __future__ import annotations

import numpy as np
from numba import njit

from endoprior.compute import simd

f4 = np.float32


@njit
def _run(a, b, c, out):
    x, y, z = simd.load(a, 3), simd.load(b, 0), simd.load(c, 0)
    results = (
        x + y, x - y, x * y, x / y, -x, simd.fma(x, y, z), simd.magnitude(x), simd.floor(x), simd.smaller(x, y),
        simd.larger(x, y), simd.where_ge(x, y, z, simd.broadcast(f4(7.0))),
        simd.scale_by_power_of_two(y, simd.floor(x)), simd.lane_numbers(), simd.broadcast(f4(2.5)),
    )  # fmt: skip
    for i in range(len(results)):
        simd.store(out, i * simd.LANES, results[i])
    return simd.total(x)


def test_operations_are_numpys():
    rng = np.random.default_rng(0)
    padded = (rng.normal(size=simd.LANES + 3) * 3).astype(f4)  # loads from offset 3: not aligned
    a = padded[3:]
    b, c = (rng.uniform(1, 2, simd.LANES).astype(f4) for _ in range(2))
    out = np.empty(14 * simd.LANES, f4)
    total = _run(padded, b, c, out)
    fused = (a.astype(np.float64) * b + c).astype(f4)  # the float64 product is exact, so this rounds once
    want = [a + b, a - b, a * b, a / b, -a, fused, np.abs(a), np.floor(a), np.minimum(a, b), np.maximum(a, b)]
    want += [np.where(a >= b, c, f4(7)), b * 2 ** np.floor(a), np.arange(simd.LANES), np.full(simd.LANES, 2.5)]
    for i, (got, expected) in enumerate(zip(out.reshape(14, -1), want, strict=True)):
        assert np.array_equal(got, expected.astype(f4)), f"operation {i}"
    halves = a
    while halves.size > 1:
        halves = halves[: halves.size // 2] + halves[halves.size // 2 :]
    assert total == halves[0]


@njit
def _copy_some(source, target, loaded, lanes):
    for k in range(len(loaded)):
        some = simd.load_some(source, 3, lanes if k else simd.LANES)  # the second load must not see the first
        simd.store(loaded[k], 0, some)
    simd.store_some(target, 2, some + simd.broadcast(f4(1.0)), lanes)


@njit
def _copy_all(source, target):
    simd.store_some(target, 2, simd.load_some(source, 3, None) + simd.broadcast(f4(1.0)), None)


def test_a_part_of_a_vector_touches_nothing_else():
    source = np.arange(40, dtype=f4)
    for lanes in (0, 1, 5, simd.LANES):
        target, loaded = np.full(40, -1, f4), np.full((2, simd.LANES), -1, f4)
        _copy_some(source, target, loaded, lanes)
        want = np.full(40, -1, f4)
        want[2 : 2 + lanes] = source[3 : 3 + lanes] + 1
        assert np.array_equal(target, want)
        part = source[3 : 3 + simd.LANES]
        assert np.array_equal(loaded, [part, np.where(np.arange(simd.LANES) < lanes, part, 0)])
    target = np.zeros(40, f4)
    _copy_all(source, target)
    assert np.array_equal(np.flatnonzero(target), np.arange(2, 2 + simd.LANES))
    assert np.array_equal(target[2 : 2 + simd.LANES], source[3 : 3 + simd.LANES] + 1)


@njit
def _ask(array, offset):
    simd.prefetch(array, offset)


def test_asking_for_a_cache_line_is_safe_anywhere():
    for offset in (0, 5, 10**9, -(10**9)):
        _ask(np.zeros(8, f4), offset)
