"""2^x of sixteen lanes at once."""

from __future__ import annotations

import numpy as np
from numba import njit

from .simd import floor, fma, scale_by_power_of_two, splat

f4 = np.float32
# Minimax fit of 2^f on [0, 1): relative error 9e-8 with these coefficients in float32.
E0, E1, E2, E3, E4, E5 = (f4(c) for c in (0.99999993, 0.69315307, 0.24015361, 0.05582634, 0.00898931, 0.00187759))


@njit(forceinline=True)
def power_of_two(exponent):
    """2^exponent; meaningless outside of [-126, 127]."""
    whole = floor(exponent)
    f = exponent - whole
    series = fma(splat(E5), f, splat(E4))
    series = fma(series, f, splat(E3))
    series = fma(series, f, splat(E2))
    series = fma(series, f, splat(E1))
    series = fma(series, f, splat(E0))
    return scale_by_power_of_two(series, whole)
