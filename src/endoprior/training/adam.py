"""Adam (Kingma and Ba, 2015): its state, and its steps, in PyTorch for any device, then in Numba for the CPU.

`skip` is a () float32 tensor on the device, or None: where it is 1, parameters, moments and counts stay as they are
(`divergence.py`); else it is 0. On a CPU it has no use: the check comes first.

Plain torch makes about six passes over parameter, gradient and moments; on a CPU the step is bound by memory, so one
pass is several times faster. Elements are independent: results do not depend on the number of threads. Cells of planes
that no gradient ever reached are skipped, exactly: their moments are zero, and dense Adam leaves them unchanged,
0 / (0 + eps) = 0. A touched cell without a new gradient still moves by its momentum and is stepped too; its gradient
need not be read or cleared.
"""

# pyright: reportCallIssue=false
from __future__ import annotations

import math
from collections.abc import Sequence

import numpy as np
import torch
from numba import njit, prange
from numpy.typing import NDArray
from torch import Tensor
from torch.optim.adam import adam

from ..compute.parallel_kernels import parallel_njit
from ..compute.simd import LANES, REORDERED, prefetch
from ..model.gaussians import RankOneGradient, UnstoredGradient
from ..model.hexplane import FRESH, TOUCHED, PlaneGrid

BETA1, BETA2 = 0.9, 0.999
CHUNK = 128  # rows per task
_AHEAD = 4  # rows between asking for the basis functions of one and updating them
_GROUP = 32  # cells in a row that one task takes at a time: a few kilobytes of each array
_TASKS = 64
_ZERO = np.float32(0)
_TINY = np.float32(np.finfo(np.float32).tiny)


class AdamState:
    """Moments of one parameter and its number of steps; a temporal basis counts the steps of each of B functions."""

    def __init__(self, param: Tensor, num_counts: int = 1) -> None:
        self.first = torch.zeros_like(param, requires_grad=False)
        self.second = torch.zeros_like(param, requires_grad=False)
        self.steps = torch.zeros(num_counts, device=param.device)
        """(num_counts,) whole numbers."""

    def arrays(self) -> dict[str, Tensor]:
        """Moments and step counts by name."""
        return {"first": self.first, "second": self.second, "steps": self.steps.to(torch.int64)}

    def load(self, arrays: dict[str, Tensor]) -> None:
        """Copy in what `arrays` gave."""
        for name, value in arrays.items():
            getattr(self, name).copy_(value)


class PlaneAdam:
    """Moments of the planes; they take memory only where cells are touched."""

    def __init__(self, grid: PlaneGrid, epsilon: float) -> None:
        self.grid, self.epsilon = grid, epsilon
        self.steps = torch.zeros((), device=grid.values.device)
        """() a whole number."""
        self.exp_avg, self.exp_avg_sq = grid.zeros(), grid.zeros()

    def arrays(self) -> dict[str, Tensor]:
        """Marks of all cells, moments of the touched ones (in order of cells) and the step count."""
        touched, steps = self.grid.marks.nonzero()[:, 0], self.steps.to(torch.int64).reshape(1)
        moments = {"exp_avg": self.exp_avg[touched], "exp_avg_sq": self.exp_avg_sq[touched]}
        return {"marks": self.grid.marks & TOUCHED, **moments, "steps": steps}

    def load(self, arrays: dict[str, Tensor]) -> None:
        """Copy in what `arrays` gave; gradients that no step consumed are dropped."""
        self.grid.clear_grads()
        self.grid.marks.copy_(arrays["marks"])
        touched = self.grid.marks.nonzero()[:, 0]
        for name in ("exp_avg", "exp_avg_sq"):
            moment = getattr(self, name)
            moment.zero_()
            moment[touched] = arrays[name].to(touched.device)
        self.steps.copy_(arrays["steps"][0])


def gradient_of(param: Tensor) -> Tensor:
    """The contiguous gradient of a tensor that has one."""
    assert param.grad is not None
    return param.grad.contiguous()


@torch.no_grad()
def adam_step(
    states: list[AdamState], params: list[Tensor], rate: float, epsilon: float, skip: Tensor | None = None
) -> None:
    """One step of several parameters with one learning rate, in place.

    Args:
        params: leaves with `.grad`, none of them empty. states: one per parameter.
    """
    values, grads = [p.detach() for p in params], [gradient_of(p) for p in params]
    _fused(values, grads, [(s.first, s.second, s.steps[0]) for s in states], rate, epsilon, skip)


@torch.no_grad()
def adam_basis_step(
    state: AdamState,
    param: Tensor,
    gradients: list[RankOneGradient],
    rates: NDArray,
    epsilon: float,
    skip: Tensor | None = None,
) -> None:
    """One step of the temporal coefficients of basis functions with a weight in any gradient; others stay unchanged.

    Adam's momentum would otherwise move tissue at time steps that were not observed.

    Args:
        param: (N, B, C). rates: (C,) learning rate of each channel.
    """
    weights = np.stack([gradient.weights for gradient in gradients])
    active = np.flatnonzero(weights.astype(np.float32).any(0))
    if len(active) == 0:
        return
    band = slice(int(active[0]), int(active[-1]) + 1)
    shares, channel_rates = (
        torch.as_tensor(each).to(param.device, param.dtype, non_blocking=True) for each in (weights[:, band], rates)
    )
    grad = torch.einsum("kb,knc->nbc", shares, torch.stack([gradient.v_offsets for gradient in gradients]))
    live = param.new_ones(()) if skip is None else 1 - skip
    grad = torch.where(live > 0, grad, 0)
    counts = state.steps[band].add_(live).clamp(min=1)[:, None]
    first, second = state.first[:, band], state.second[:, band]
    first.lerp_(grad, (1 - BETA1) * live)
    second.lerp_(grad.square(), (1 - BETA2) * live)
    root_scale = (1 - BETA2**counts).rsqrt()
    step = live * channel_rates / (1 - BETA1**counts) * first / (second.sqrt() * root_scale + epsilon)
    param.detach()[:, band].sub_(step)


@torch.no_grad()
def adam_planes_step(planes: PlaneAdam, rate: float, skip: Tensor | None = None) -> None:
    """One step of all planes of a HexPlane field; their gradients are then cleared."""
    grid = planes.grid
    moments = [(planes.exp_avg, planes.exp_avg_sq, planes.steps)]
    _fused([grid.values], [grid.grads], moments, rate, planes.epsilon, skip)
    grid.grads.zero_()
    grid.marks.fill_(TOUCHED)


def _fused(
    params: list[Tensor],
    grads: list[Tensor],
    states: list[tuple[Tensor, Tensor, Tensor]],
    rate: float,
    epsilon: float,
    skip: Tensor | None,
) -> None:
    """PyTorch's fused kernel: one pass over memory, many small tensors per launch."""
    firsts, seconds, steps = (list(each) for each in zip(*states, strict=True))
    adam(
        params, grads, firsts, seconds, [], steps,
        fused=True, found_inf=skip, amsgrad=False, beta1=BETA1, beta2=BETA2, lr=rate, weight_decay=0.0, eps=epsilon,
        maximize=False,
    )  # fmt: skip


def count_unusable(gradient: Tensor, limit: float) -> Tensor:
    """() entries that are NaN, infinite, or of a magnitude beyond `limit`."""
    return (~(gradient.detach().abs() <= limit)).sum()


def count_unusable_in_planes(grid: PlaneGrid, limit: float) -> Tensor:
    """`count_unusable` of the gradient of all planes of a HexPlane field."""
    return count_unusable(grid.grads, limit)


def adam_step_numba(
    states: list[AdamState], params: list[Tensor], rate: float, epsilon: float, _skip: None = None
) -> None:
    """See `adam_step`."""
    for state, param in zip(states, params, strict=True):
        rates, root_scales = _corrected(np.array([rate]), _counted(state))
        tensors = (param, gradient_of(param), state.first, state.second)
        _adam_flat(*(t.detach().reshape(-1).numpy() for t in tensors), rates[0], root_scales[0], *_constants(epsilon))


def adam_basis_step_numba(
    state: AdamState,
    param: Tensor,
    gradients: list[RankOneGradient],
    rates: NDArray,
    epsilon: float,
    _skip: None = None,
) -> None:
    """See `adam_basis_step`."""
    weights = np.stack([gradient.weights for gradient in gradients]).astype(np.float32)
    active = np.flatnonzero(weights.any(0))
    if len(active) == 0:
        return
    begin, end = int(active[0]), int(active[-1]) + 1
    scaled, root_scales = _corrected(rates[None, :], _counted(state, slice(begin, end))[:, None])
    v_offsets = np.stack([gradient.v_offsets.numpy() for gradient in gradients])
    views = (param.detach().numpy(), weights, v_offsets, state.first.numpy(), state.second.numpy())
    _adam_outer(*views, begin, scaled, root_scales[:, 0], *_constants(epsilon))


def adam_unstored_step(
    states: list[AdamState], params: list[Tensor], gradients: Sequence[UnstoredGradient], rate: float, epsilon: float
) -> None:
    """Like `adam_step_numba`, with a gradient that is computed where it is used."""
    counts = [_counted(state) for state in states]
    rates, root_scales = _corrected(np.array([rate]), counts[0])
    held = zip(*((param, state.first, state.second) for param, state in zip(params, states, strict=True)), strict=True)
    arrays = [[tensor.detach().numpy() for tensor in tensors] for tensors in held]
    gradients[0].adam_step(gradients, *arrays, rates[0], root_scales[0], _constants(epsilon))


def _counted(state: AdamState, functions: slice = slice(None)) -> NDArray[np.int64]:
    """Numbers of steps, this one included."""
    state.steps[functions] += 1
    return state.steps[functions].numpy().astype(np.int64)


def _corrected(rates: NDArray, steps: NDArray) -> tuple[NDArray, NDArray]:
    """Learning rates / (1 - beta1^steps), and 1 / sqrt(1 - beta2^steps): Adam's bias corrections."""
    return (rates / (1 - BETA1**steps)).astype(np.float32), (1 / np.sqrt(1 - BETA2**steps)).astype(np.float32)


def _constants(epsilon: float) -> tuple[np.float32, np.float32, np.float32]:
    return np.float32(BETA1), np.float32(BETA2), np.float32(epsilon)


@parallel_njit(fastmath=REORDERED)
def _adam_flat(param, grad, first, second, rate, root_scale, beta1, beta2, epsilon):
    # Update every element; param, grad, first, second (n,) float32, all scalars float32. Inputs are trusted.
    # rate = lr / (1 - beta1**step), root_scale = 1 / sqrt(1 - beta2**step).
    one = np.float32(1)
    for i in prange(param.size):
        g = grad[i]
        m = beta1 * first[i] + (one - beta1) * g
        v = beta2 * second[i] + (one - beta2) * g * g
        first[i] = m
        second[i] = v
        param[i] -= rate * m / (np.sqrt(v) * root_scale + epsilon)


@parallel_njit(fastmath=REORDERED)
def _adam_outer(param, weights, v, first, second, begin, rate, root_scale, beta1, beta2, epsilon):
    # Like `_adam_flat` for a gradient that is a sum of outer products: grad[r, b, c] = sum_k weights[k, b] v[k, r, c].
    # param, first, second (R, B, C); weights (K, B), v (K, R, C) float32. Updates basis functions begin .. begin +
    # rate.shape[0]; rate (b, C) and root_scale (b,).
    num_rows, num_bases, channels = param.shape
    bases = rate.shape[0]
    width, start = bases * channels, begin * channels
    # Basis functions and channels of a row are contiguous: one long loop over both vectorizes, 13 channels do not.
    rates, root_scales = np.empty(width, np.float32), np.empty(width, np.float32)
    for i in range(width):
        rates[i], root_scales[i] = rate[i // channels, i % channels], root_scale[i // channels]
    stride = num_bases * channels
    params, firsts, seconds = param.reshape(-1), first.reshape(-1), second.reshape(-1)
    one = np.float32(1)
    for task in prange((num_rows + CHUNK - 1) // CHUNK):
        grad = np.empty(width, np.float32)
        for r in range(task * CHUNK, min(num_rows, (task + 1) * CHUNK)):
            # Each row is updated in one short piece, too short for the hardware prefetcher to foresee the next row.
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


def adam_planes_step_numba(planes: PlaneAdam, rate: float, _skip: None = None) -> None:
    """See `adam_planes_step`; marks tell the cells that were ever touched, and those with a new gradient."""
    planes.steps += 1
    grid, step = planes.grid, int(planes.steps)
    arrays = (t.numpy() for t in (grid.values, grid.grads, planes.exp_avg, planes.exp_avg_sq, grid.marks))
    scaled, correction = rate / (1 - BETA1**step), 1 / math.sqrt(1 - BETA2**step)
    _step_cells(*arrays, *map(np.float32, (1 - BETA1, BETA2, 1 - BETA2, scaled, correction, planes.epsilon)))


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


@parallel_njit(fastmath={"contract", "nsz"})
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
                    g = _ZERO
                    for c in range(channels):
                        _update(i, c, g, values, exp_avg, exp_avg_sq, blend1, beta2, blend2, rate, correction, epsilon)


def count_unusable_numba(gradient: Tensor, limit: float) -> int:
    """See `count_unusable`."""
    return int(_count(gradient.detach().contiguous().reshape(-1).numpy(), np.float32(limit)))


def count_unusable_in_planes_numba(grid: PlaneGrid, limit: float) -> int:
    """See `count_unusable_in_planes`; reads the cells that have a gradient only."""
    return int(_count_rows(grid.grads.numpy(), grid.marks.numpy(), FRESH, np.float32(limit)))


@parallel_njit()
def _count(values, limit):
    bad = 0
    for i in prange(values.size):
        if not abs(values[i]) <= limit:
            bad += 1
    return bad


@parallel_njit()
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
