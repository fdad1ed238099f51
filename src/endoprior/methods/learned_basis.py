"""Functions of time that are sums of a few short basis functions, each with a weight, a center and a width of its own.

f(t) = sum_b w_b exp(-((t - c_b)^2 / (s_b^2 + 1e-4))^2). The power of 4 makes a basis function flat at its center and
end soon; the 1e-4 keeps its half width above 0.01. Yang et al., "Deform3DGS", MICCAI 2024, as released.

`N` Gaussians, `B` basis functions, `C` channels.
"""

from __future__ import annotations

from typing import Any

import torch
from torch import Tensor
from torch.autograd.function import once_differentiable

from . import learned_basis_numba


def value_at(weights: Tensor, centers: Tensor, widths: Tensor, time: float) -> Tensor:
    """f(t) of each Gaussian and channel, differentiable in the three coefficients.

    Args:
        weights, centers, widths: (N, B, C) w, c, s; c and s in units of the sequence, as `time`.
        time: t, in [0, 1].
    Returns:
        (N, C).
    """
    if weights.device.type == "cpu" and weights.dtype == torch.float32:
        return _Compiled.apply(weights, centers, widths, time)
    ratio = (time - centers) ** 2 / (widths**2 + float(learned_basis_numba.SMALLEST_SQUARE))
    return (weights * torch.exp(-(ratio**2))).sum(1)


class _Compiled(torch.autograd.Function):
    """`value_at` without the (N, B, C) tensors in between: few basis functions reach any one time."""

    @staticmethod
    def forward(ctx: Any, weights: Tensor, centers: Tensor, widths: Tensor, time: float) -> Tensor:
        ctx.save_for_backward(weights, centers, widths)
        ctx.time = time
        arrays = [tensor.detach().contiguous().numpy() for tensor in (weights, centers, widths)]
        return torch.from_numpy(learned_basis_numba.value_at(*arrays, time))

    @staticmethod
    @once_differentiable
    def backward(ctx: Any, v_value: Tensor) -> tuple[Tensor, Tensor, Tensor, None]:
        arrays = [tensor.detach().contiguous().numpy() for tensor in ctx.saved_tensors]
        found = learned_basis_numba.value_at_backward(*arrays, ctx.time, v_value.contiguous().numpy())
        return (*map(torch.from_numpy, found), None)
