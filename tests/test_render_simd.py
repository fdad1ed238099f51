"""The vector type: each operation against NumPy, lane by lane."""

from __future__ import annotations

import numpy as np
from numba import njit

from endoprior.render import simd

f4 = np.float32


@njit
def _run(a, b, c, out):
    x, y, z = simd.load(a, 3), simd.load(b, 0), simd.load(c, 0)
    results = (
        x + y, x - y, x * y, x / y, -x, simd.fma(x, y, z), simd.magnitude(x), simd.floor(x), simd.smaller(x, y),
        simd.larger(x, y), simd.where_ge(x, y, z, simd.splat(f4(7.0))), simd.scale_by_power_of_two(y, simd.floor(x)),
        simd.lane_numbers(), simd.splat(f4(2.5)),
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
