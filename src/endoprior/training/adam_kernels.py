"""One Adam update in one pass over memory.

Plain torch makes about six passes over parameter, gradient and moments; on a CPU the update is bound by memory, so one
pass is several times faster. Every element is independent: results do not depend on the number of threads.
"""

from __future__ import annotations

import numpy as np
import torch
from numba import njit, prange
from torch import Tensor
from torch.optim.adam import adam

from ..compute.simd import LANES, prefetch

BETA1, BETA2 = 0.9, 0.999
FLAGS = {"reassoc", "contract", "nsz", "arcp", "afn"}
CHUNK = 128  # rows per task
_AHEAD = 4  # rows between asking for the bases of one and updating them


@torch.no_grad()
def adam_definition(
    param: Tensor,
    grad: Tensor,
    first: Tensor,
    second: Tensor,
    rate: float | Tensor,
    root_scale: float | Tensor,
    epsilon: float,
    live: Tensor | None = None,
) -> None:
    """p -= rate * m / (sqrt(v) * root_scale + epsilon), after both moments took in the gradient; all in place.

    Args:
        param, grad, first, second: of one shape. rate, root_scale: corrected for young moments, broadcast.
        live: bool, broadcast; where it is False nothing changes, whatever `grad` holds.
    """
    blend1, blend2 = 1 - BETA1, 1 - BETA2
    if live is not None:
        grad, rate, blend1, blend2 = torch.where(live, grad, 0), rate * live, blend1 * live, blend2 * live
    first.lerp_(grad, blend1)
    second.lerp_(grad.square(), blend2)
    param.sub_(rate * first / (second.sqrt() * root_scale + epsilon))


@torch.no_grad()
def fused_step(
    params: list[Tensor],
    grads: list[Tensor],
    firsts: list[Tensor],
    seconds: list[Tensor],
    steps: list[Tensor],
    rate: float | Tensor,
    epsilon: float,
    frozen: Tensor | None = None,
) -> None:
    """One step of Adam in place, in one pass over memory, by torch's own kernel: of many small tensors at once.

    Args:
        params, grads, firsts, seconds: of equal shapes, contiguous. steps: () float32 each, counted up.
        rate: a number, or () on the same device.
        frozen: () float32 on the same device; where it is 1, nothing changes; else it is 0.
    """
    adam(
        params, grads, firsts, seconds, [], steps,
        fused=True, found_inf=frozen, amsgrad=False, beta1=BETA1, beta2=BETA2, lr=rate, weight_decay=0.0, eps=epsilon,
        maximize=False,
    )  # fmt: skip


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
    num_rows, num_bases, channels = param.shape
    bases = rate.shape[0]
    width, start = bases * channels, begin * channels
    # Bases and channels of a row lie side by side: one long loop over both vectorizes, 13 channels alone do not.
    rates, root_scales = np.empty(width, np.float32), np.empty(width, np.float32)
    for i in range(width):
        rates[i], root_scales[i] = rate[i // channels, i % channels], root_scale[i // channels]
    stride = num_bases * channels
    params, firsts, seconds = param.reshape(-1), first.reshape(-1), second.reshape(-1)
    one = np.float32(1)
    for task in prange((num_rows + CHUNK - 1) // CHUNK):
        grad = np.empty(width, np.float32)
        for r in range(task * CHUNK, min(num_rows, (task + 1) * CHUNK)):
            # What is updated is a short piece of each row: too short for the processor to foresee the next one.
            ahead = (r + _AHEAD) * stride + start
            for i in range(0, width + LANES, LANES):
                prefetch(params, ahead + i)
                prefetch(firsts, ahead + i)
                prefetch(seconds, ahead + i)
            grad[:] = np.float32(0)
            for k in range(weights.shape[0]):
                for b in range(bases):
                    for c in range(channels):
                        grad[b * channels + c] += weights[k, begin + b] * v[k, r, c]
            place = r * stride + start
            p, m, u = params[place : place + width], firsts[place : place + width], seconds[place : place + width]
            for i in range(width):
                m[i] = beta1 * m[i] + (one - beta1) * grad[i]
                u[i] = beta2 * u[i] + (one - beta2) * grad[i] * grad[i]
                p[i] -= rates[i] * m[i] / (np.sqrt(u[i]) * root_scales[i] + epsilon)
