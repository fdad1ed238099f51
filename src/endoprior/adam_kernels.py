"""One Adam update in one pass over memory.

Plain torch makes about six passes over parameter, gradient and moments; on a CPU the update is bound by memory, so one
pass is several times faster. Every element is independent: results do not depend on the number of threads.
"""

from __future__ import annotations

import numpy as np
from numba import njit, prange

FLAGS = {"reassoc", "contract", "nsz", "arcp", "afn"}


@njit(parallel=True, cache=True, fastmath=FLAGS)
def adam_columns(param, grad, first, second, begin, rate, root_scale, beta1, beta2, epsilon):
    """Update columns begin .. begin + len(rate) of every row.

    param, grad, first, second (R, C) float32; rate, root_scale (c,) float32 per column: lr / (1 - beta1**step) and
    1 / sqrt(1 - beta2**step). p -= rate * m / (sqrt(v) * root_scale + epsilon), Kingma and Ba's update. Trusted inputs.
    """
    one = np.float32(1)
    for r in prange(param.shape[0]):
        for c in range(rate.size):
            k = begin + c
            g = grad[r, k]
            m = beta1 * first[r, k] + (one - beta1) * g
            v = beta2 * second[r, k] + (one - beta2) * g * g
            first[r, k] = m
            second[r, k] = v
            param[r, k] -= rate[c] * m / (np.sqrt(v) * root_scale[c] + epsilon)
