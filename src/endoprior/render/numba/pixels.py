"""What one Gaussian does to LANES pixels of a row. Both compositing passes inline it, so their decisions agree.

A Gaussian comes as the LDL^T factors of its conic (see `projection`): with (dx, dy) measured from its center,
`alpha = opacity exp(-(a (dx + k dy)^2 + m dy^2) / 2) = 2^(log2(opacity) - (root dx + root k dy)^2 - m_log2 dy^2)`,
where `root = sqrt(a log2(e) / 2)` and `m_log2 = m log2(e) / 2`.
"""

from __future__ import annotations

from math import log2

import numpy as np
from numba import njit

from ...compute.exponential import power_of_two
from ...compute.simd import fma, magnitude, smaller, splat, where_ge
from ..constants import ALPHA_MAX, ALPHA_MIN, STOP_TRANSMITTANCE

f4 = np.float32
LOG2_ALPHA_MIN = f4(log2(ALPHA_MIN))
LARGEST_ALPHA = f4(ALPHA_MAX)
STOP = f4(STOP_TRANSMITTANCE)


@njit(forceinline=True)
def log2_alpha(base, root_k, m_log2, log2_opacity, dy):
    """Exponent of alpha on the row at dy; `base` is root dx of the pixels. All are vectors, as is the result."""
    u = fma(root_k, dy, base)
    return fma(-u, u, fma(-m_log2 * dy, dy, log2_opacity))


@njit(forceinline=True)
def blend(exponent, transmittance):
    """Alpha of the Gaussian at the pixels, its weight, which is 0 where it does not count, and the transmittance behind
    it.

    A transmittance below STOP marks a pixel that is full: its magnitude stays what it was and nothing more is added.
    All are vectors.
    """
    zero = splat(f4(0.0))
    alpha = smaller(power_of_two(exponent), splat(LARGEST_ALPHA))
    alpha = where_ge(exponent, splat(LOG2_ALPHA_MIN), alpha, zero)
    behind = fma(-transmittance, alpha, transmittance)
    stop = splat(STOP)
    weight = where_ge(behind, stop, transmittance * alpha, zero)
    return alpha, weight, where_ge(behind, stop, behind, -magnitude(transmittance))
