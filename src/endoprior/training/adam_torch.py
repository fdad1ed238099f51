"""Adam in PyTorch, on any device.

`skip` is a () float32 tensor on the device, or None: where it is 1, parameters, moments and counts stay as they are
(`divergence.py`); else it is 0.
"""

from __future__ import annotations

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor
from torch.optim.adam import adam

from ..model.basis import RankOneGradient
from ..model.hexplane import TOUCHED
from .adam import BETA1, BETA2, AdamState
from .plane_adam import PlaneAdam


@torch.no_grad()
def adam_step(
    states: list[AdamState], params: list[Tensor], rate: float, epsilon: float, skip: Tensor | None = None
) -> None:
    """One step of several parameters with one learning rate, in place.

    Args:
        params: leaves with `.grad`, none of them empty. states: one per parameter.
    """
    _fused(
        [p.detach() for p in params],
        [p.grad.contiguous() for p in params],
        [s.first for s in states],
        [s.second for s in states],
        [s.steps[0] for s in states],
        rate,
        epsilon,
        skip,
    )


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
    weights, rates = (torch.as_tensor(v).to(param.device, param.dtype, non_blocking=True) for v in (weights, rates))
    grad = sum(w[band, None] * g.v_offsets[:, None] for w, g in zip(weights, gradients, strict=True))
    live = 1.0 if skip is None else 1 - skip
    if skip is not None:
        grad = torch.where(skip == 0, grad, 0)
    steps = state.steps[band].add_(live)
    counts = steps.clamp(min=1)[:, None]
    first, second = state.first[:, band], state.second[:, band]
    first.lerp_(grad, (1 - BETA1) * live)
    second.lerp_(grad.square(), (1 - BETA2) * live)
    root_scale = (1 - BETA2**counts).rsqrt()
    param.detach()[:, band].sub_(live * rates / (1 - BETA1**counts) * first / (second.sqrt() * root_scale + epsilon))


@torch.no_grad()
def adam_planes_step(planes: PlaneAdam, rate: float, skip: Tensor | None = None) -> None:
    """One step of all planes of a HexPlane field; their gradients are then cleared."""
    grid = planes.grid
    buffers = (grid.values, grid.grads, planes.exp_avg, planes.exp_avg_sq, planes.steps)
    _fused(*([buffer] for buffer in buffers), rate, planes.epsilon, skip)
    grid.grads.zero_()
    grid.marks.fill_(TOUCHED)


def _fused(
    params: list[Tensor],
    grads: list[Tensor],
    firsts: list[Tensor],
    seconds: list[Tensor],
    steps: list[Tensor],
    rate: float,
    epsilon: float,
    skip: Tensor | None,
) -> None:
    """PyTorch's fused kernel: one pass over memory, many small tensors per launch."""
    adam(
        params, grads, firsts, seconds, [], steps,
        fused=True, found_inf=skip, amsgrad=False, beta1=BETA1, beta2=BETA2, lr=rate, weight_decay=0.0, eps=epsilon,
        maximize=False,
    )  # fmt: skip
