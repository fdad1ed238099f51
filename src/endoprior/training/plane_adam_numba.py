"""Adam over the planes in Numba that skips, exactly, the cells that no gradient ever reached. CPU, float32.

A cell whose gradients were all zero has zero moments, and dense Adam leaves it unchanged: 0 / (0 + eps) = 0. So
stepping only the touched cells gives the numbers of dense Adam with a fraction of the memory traffic. A touched cell
without a new gradient still moves by its momentum and is stepped too; its gradient need not be read or cleared.
"""

from __future__ import annotations

import math

import numpy as np
from numba import njit, prange
from torch import Tensor

from ..model.hexplane import FRESH, TOUCHED
from .adam import BETA1, BETA2
from .plane_adam import PlaneAdam

_GROUP = 32  # cells in a row that one task takes at a time: a few kilobytes of each array
_TASKS = 64
_ZERO = np.float32(0)
_TINY = np.float32(np.finfo(np.float32).tiny)


def adam_planes_step(planes: PlaneAdam, rate: float, skip: Tensor | None = None) -> None:
    """See `adam_torch.adam_planes_step`; `skip` has no use here: the divergence check comes first on a CPU."""
    grid = planes.grid
    planes.steps += 1
    buffers = (grid.values, grid.grads, planes.exp_avg, planes.exp_avg_sq, grid.marks)
    step_cells(*buffers, int(planes.steps), rate, planes.epsilon)


def step_cells(
    values: Tensor,
    grads: Tensor,
    exp_avg: Tensor,
    exp_avg_sq: Tensor,
    marks: Tensor,
    step: int,
    rate: float,
    epsilon: float,
) -> None:
    """Update, in place, the rows of `values` that `marks` calls touched, and clear their gradients.

    Args:
        values, grads, exp_avg, exp_avg_sq: (cells, C) float32, contiguous; rows with mark 0 must have zero gradient.
        marks: (cells,) uint8 of `TOUCHED` and `FRESH` bits; FRESH is cleared.
        step: number of this step, from 1. rate: learning rate.
    """
    _step_cells(
        *(t.numpy() for t in (values, grads, exp_avg, exp_avg_sq, marks)),
        np.float32(1 - BETA1),
        np.float32(BETA2),
        np.float32(1 - BETA2),
        np.float32(rate / (1 - BETA1**step)),
        np.float32(1 / math.sqrt(1 - BETA2**step)),
        np.float32(epsilon),
    )


@njit(inline="always")
def _update(i, c, g, values, exp_avg, exp_avg_sq, blend1, beta2, blend2, rate, correction, epsilon):
    # Adam of channel c of cell i with gradient g. First moments below the normal range become 0: they move nothing,
    # would stay for ever, and many processors take a hundred times longer over them.
    m = exp_avg[i, c] + blend1 * (g - exp_avg[i, c])
    m = m if abs(m) >= _TINY else _ZERO
    v = beta2 * exp_avg_sq[i, c] + blend2 * (g * g)
    exp_avg[i, c] = m
    exp_avg_sq[i, c] = v
    values[i, c] -= rate * m / (math.sqrt(v) * correction + epsilon)


@njit(parallel=True, cache=True, fastmath={"contract", "nsz"})
def _step_cells(values, grads, exp_avg, exp_avg_sq, marks, blend1, beta2, blend2, rate, correction, epsilon):
    # Tasks take groups of cells in turn, because touched cells lie in clusters. Cells are independent of each other.
    cells, channels = values.shape
    for task in prange(_TASKS):
        for group in range(task, (cells + _GROUP - 1) // _GROUP, _TASKS):
            for i in range(group * _GROUP, min(cells, (group + 1) * _GROUP)):
                if marks[i] & FRESH:
                    for c in range(channels):
                        g = grads[i, c]
                        _update(i, c, g, values, exp_avg, exp_avg_sq, blend1, beta2, blend2, rate, correction, epsilon)
                        grads[i, c] = _ZERO
                    marks[i] = TOUCHED
                elif marks[i]:
                    for c in range(channels):
                        _update(
                            i, c, _ZERO, values, exp_avg, exp_avg_sq, blend1, beta2, blend2, rate, correction, epsilon
                        )
