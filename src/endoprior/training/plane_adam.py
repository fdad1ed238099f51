"""Adam over the planes that skips, exactly, the cells no gradient ever reached.

A cell whose gradients were all zero has zero moments, and dense Adam leaves it where it is: 0 / (0 + eps) = 0. So
stepping only the touched cells gives the numbers of dense Adam at a fraction of the memory traffic. A touched cell
without a new gradient still moves by its momentum and is stepped too, but its gradient need not be read or cleared.

Kingma and Ba, "Adam", 2015, Algorithm 1, with the bias corrections applied as in torch.optim.Adam.
"""

from __future__ import annotations

import math

import numpy as np
import torch
from numba import njit, prange
from torch import Tensor

from ..compute.compiled import compiled
from ..model.hexplane import PlaneGrid
from ..model.hexplane_kernels import FRESH, TOUCHED
from .adam_kernels import BETA1, BETA2, fused_step

_GROUP = 32  # cells in a row that one task takes at a time: a few kilobytes of each array
_TASKS = 64
_ZERO = np.float32(0)
_TINY = np.float32(np.finfo(np.float32).tiny)


class PlaneAdam:
    """Moments of the planes and the step that uses them."""

    def __init__(self, grid: PlaneGrid, *, epsilon: float = 1e-15) -> None:
        """Start with zero moments at step 0. Moments take memory only where cells are touched."""
        self.grid, self.epsilon = grid, epsilon
        self.steps = torch.zeros((), device=grid.values.device)
        """() a whole number."""
        self.exp_avg, self.exp_avg_sq = grid.zeros(), grid.zeros()

    def step(self, lr: float | Tensor, frozen: Tensor | None = None) -> None:
        """Apply one step with learning rate `lr`, then clear the gradients; `frozen` is that of `AdamState`."""
        grid = self.grid
        buffers = (grid.values, grid.grads, self.exp_avg, self.exp_avg_sq)
        if not compiled(grid.values):
            fused_step(*([buffer] for buffer in (*buffers, self.steps)), lr, self.epsilon, frozen)
            grid.grads.zero_()
            grid.marks.fill_(TOUCHED)
            return
        self.steps += 1
        plane_adam_step(*buffers, grid.marks, int(self.steps), lr, epsilon=self.epsilon)

    def state_arrays(self) -> dict[str, Tensor]:
        """What a resumed run needs: marks of all cells, moments of the touched ones (in order of cells), step count."""
        touched = self.grid.marks.nonzero()[:, 0]
        return {
            "plane_adam.marks": self.grid.marks & TOUCHED,
            "plane_adam.exp_avg": self.exp_avg[touched],
            "plane_adam.exp_avg_sq": self.exp_avg_sq[touched],
            "plane_adam.steps": self.steps.to(torch.int64).reshape(1),
        }

    def load_state_arrays(self, arrays: dict[str, Tensor]) -> None:
        """Take over what `state_arrays` gave; gradients in flight are dropped."""
        self.grid.clear_grads()
        self.grid.marks.copy_(arrays["plane_adam.marks"])
        touched = self.grid.marks.nonzero()[:, 0]
        self.exp_avg.zero_()
        self.exp_avg_sq.zero_()
        self.exp_avg[touched] = arrays["plane_adam.exp_avg"].to(touched.device)
        self.exp_avg_sq[touched] = arrays["plane_adam.exp_avg_sq"].to(touched.device)
        self.steps.copy_(arrays["plane_adam.steps"][0])


def plane_adam_step(
    values: Tensor,
    grads: Tensor,
    exp_avg: Tensor,
    exp_avg_sq: Tensor,
    marks: Tensor,
    step: int,
    lr: float,
    betas: tuple[float, float] = (BETA1, BETA2),
    epsilon: float = 1e-15,
) -> None:
    """Update, in place, the rows of `values` that `marks` calls touched, and clear their gradients.

    Args:
        values, grads, exp_avg, exp_avg_sq: (cells, C) float32, contiguous; rows with mark 0 must have zero gradient.
        marks: (cells,) uint8 of `TOUCHED` and `FRESH` bits; FRESH is taken off.
        step: number of this step, from 1.
        lr: learning rate.
    """
    beta1, beta2 = betas
    _step_rows(
        values.numpy(),
        grads.numpy(),
        exp_avg.numpy(),
        exp_avg_sq.numpy(),
        marks.numpy(),
        np.float32(1 - beta1),
        np.float32(beta2),
        np.float32(1 - beta2),
        np.float32(lr / (1 - beta1**step)),
        np.float32(1 / math.sqrt(1 - beta2**step)),
        np.float32(epsilon),
    )


@njit(parallel=True, cache=True, fastmath={"contract", "nsz"})
def _step_rows(values, grads, exp_avg, exp_avg_sq, marks, blend1, beta2, blend2, rate, correction, epsilon):
    # Tasks take groups of rows in turn, because touched rows lie in clusters. Rows are independent of each other.
    # First moments that decay below the normal range become 0: they move nothing, stay for ever, and many processors
    # take a hundred times longer over them.
    rows, channels = values.shape
    for task in prange(_TASKS):
        for group in range(task, (rows + _GROUP - 1) // _GROUP, _TASKS):
            for i in range(group * _GROUP, min(rows, (group + 1) * _GROUP)):
                if marks[i] & FRESH:
                    for c in range(channels):
                        g = grads[i, c]
                        m = exp_avg[i, c] + blend1 * (g - exp_avg[i, c])
                        m = m if abs(m) >= _TINY else _ZERO
                        v = beta2 * exp_avg_sq[i, c] + blend2 * (g * g)
                        exp_avg[i, c] = m
                        exp_avg_sq[i, c] = v
                        values[i, c] -= rate * m / (math.sqrt(v) * correction + epsilon)
                        grads[i, c] = _ZERO
                    marks[i] = TOUCHED
                elif marks[i]:
                    for c in range(channels):
                        m = exp_avg[i, c] - blend1 * exp_avg[i, c]
                        m = m if abs(m) >= _TINY else _ZERO
                        v = beta2 * exp_avg_sq[i, c]
                        exp_avg[i, c] = m
                        exp_avg_sq[i, c] = v
                        values[i, c] -= rate * m / (math.sqrt(v) * correction + epsilon)
