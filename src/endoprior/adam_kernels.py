"""One Adam update in one pass over memory.

Plain torch makes about six passes over parameter, gradient and moments; on a CPU the update is bound by memory, so one
pass is several times faster. Every element is independent: results do not depend on the number of threads.
"""

from __future__ import annotations

import numpy as np
from numba import njit, prange

FLAGS = {"reassoc", "contract", "nsz", "arcp", "afn"}


@njit(parallel=True, cache=True, fastmath=FLAGS)
def adam_flat(param, grad, first, second, rate, root_scale, beta1, beta2, epsilon):
    """Update every element: p -= rate * m / (sqrt(v) * root_scale + epsilon), Kingma and Ba's update.

    param, grad, first, second (n,) float32; rate = lr / (1 - beta1**step), root_scale = 1 / sqrt(1 - beta2**step), and
    all scalars float32. Trusted inputs.
    """
    one = np.float32(1)
    for i in prange(param.size):
        g = grad[i]
        m = beta1 * first[i] + (one - beta1) * g
        v = beta2 * second[i] + (one - beta2) * g * g
        first[i] = m
        second[i] = v
        param[i] -= rate * m / (np.sqrt(v) * root_scale + epsilon)


@njit(parallel=True, cache=True, fastmath=FLAGS)
def adam_outer(param, weights, v, first, second, begin, rate, root_scale, beta1, beta2, epsilon):
    """Like `adam_flat` for a gradient that is a sum of outer products: grad[r, b, c] = sum_k weights[k, b] v[k, r, c].

    param, first, second (R, B, C); weights (K, B), v (K, R, C) float32. Updates bases begin .. begin + rate.shape[0];
    rate (b, C) and root_scale (b,).
    """
    one = np.float32(1)
    for r in prange(param.shape[0]):
        for i in range(rate.shape[0]):
            b = begin + i
            for c in range(param.shape[2]):
                g = np.float32(0)
                for k in range(weights.shape[0]):
                    g += weights[k, b] * v[k, r, c]
                m = beta1 * first[r, b, c] + (one - beta1) * g
                u = beta2 * second[r, b, c] + (one - beta2) * g * g
                first[r, b, c] = m
                second[r, b, c] = u
                param[r, b, c] -= rate[i, c] * m / (np.sqrt(u) * root_scale[i] + epsilon)
