"""Counting gradient entries that Adam must not be given, in Numba. CPU, float32."""

from __future__ import annotations

import numpy as np
from numba import njit, prange
from torch import Tensor

from ..model.hexplane import FRESH, PlaneGrid


def count_unusable(gradient: Tensor, limit: float) -> int:
    """See `gradients_torch.count_unusable`."""
    return int(_count(gradient.detach().contiguous().reshape(-1).numpy(), np.float32(limit)))


def count_unusable_in_planes(grid: PlaneGrid, limit: float) -> int:
    """See `gradients_torch.count_unusable_in_planes`; reads the cells that have a gradient only."""
    return int(_count_rows(grid.grads.numpy(), grid.marks.numpy(), FRESH, np.float32(limit)))


@njit(parallel=True, cache=True)
def _count(values, limit):
    bad = 0
    for i in prange(values.size):
        if not abs(values[i]) <= limit:
            bad += 1
    return bad


@njit(parallel=True, cache=True)
def _count_rows(values, marks, mark, limit):
    bad = 0
    for i in prange(values.shape[0]):
        found = 0
        if marks[i] & mark:
            for c in range(values.shape[1]):
                if not abs(values[i, c]) <= limit:
                    found += 1
        bad += found
    return bad
