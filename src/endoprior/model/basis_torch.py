"""The temporal basis in PyTorch: sums of coefficients weighted by the basis functions, on any device."""

from __future__ import annotations

import torch
from numpy.typing import NDArray
from torch import Tensor


def weighted_sum(motion: Tensor, weights: NDArray) -> Tensor:
    """(N, C) sum_b weights[b] * motion[:, b].

    Args:
        motion: (N, B, C) coefficients. weights: (B,) values of the basis functions.
    """
    return torch.matmul(_like(weights, motion), motion)


def weighted_sum_backward(v_out: Tensor, weights: NDArray) -> Tensor:
    """(N, B, C) gradient of `motion`, given that of the sum, (N, C)."""
    return v_out[:, None] * _like(weights, v_out)[:, None]


def _like(weights: NDArray, values: Tensor) -> Tensor:
    return torch.as_tensor(weights).to(values.device, values.dtype, non_blocking=True)
