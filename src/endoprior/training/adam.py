"""Adam (Kingma and Ba, 2015): its state, and its steps in PyTorch, on any device; `adam_numba.py` does them on a CPU.

`skip` is a () float32 tensor on the device, or None: where it is 1, parameters, moments and counts stay as they are
(`divergence.py`); else it is 0.
"""

from __future__ import annotations

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor
from torch.optim.adam import adam

from ..model.hexplane import TOUCHED, PlaneGrid
from ..model.motion import RankOneGradient

BETA1, BETA2 = 0.9, 0.999


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
