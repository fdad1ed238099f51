"""Functions of time that are sums of a few short basis functions, each with a weight, a center and a width of its own.

f(t) = sum_b w_b exp(-((t - c_b)^2 / (s_b^2 + 1e-4))^2). The power of 4 makes a basis function flat at its center and
end soon; the 1e-4 keeps its half width above 0.01. Yang et al., "Deform3DGS", MICCAI 2024, as released.

`N` Gaussians, `B` basis functions, `C` channels.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
import torch
from torch import Tensor
from torch.autograd.function import once_differentiable

from endoprior.model.motion import UnstoredGradient

from . import learned_basis_numba

COEFFICIENTS = ("basis_weights", "basis_centers", "basis_widths")
"""Names of the tensors w, c, s of the Gaussians, (N, B, C) each."""


@dataclass(frozen=True)
class LearnedBasisGradient(UnstoredGradient):
    """See `UnstoredGradient`."""

    names = COEFFICIENTS
    time: float
    v_offsets: Tensor

    @staticmethod
    def adam_step(gradients: Sequence[LearnedBasisGradient], *args: Any) -> None:
        """See `UnstoredGradient.adam_step`."""
        times = np.array([gradient.time for gradient in gradients], np.float32)
        v_values = np.stack([gradient.v_offsets.numpy() for gradient in gradients])
        tensors, firsts, seconds, *scalars = args
        learned_basis_numba.adam_step(tensors, firsts, seconds, times, v_values, *scalars)


def value_at(
    weights: Tensor,
    centers: Tensor,
    widths: Tensor,
    time: float,
    sink: list[LearnedBasisGradient] | None = None,
) -> Tensor:
    """f(t) of each Gaussian and channel, differentiable in the three coefficients.

    Args:
        weights, centers, widths: (N, B, C) w, c, s; c and s in units of the sequence, as `time`.
        time: t, in [0, 1].
        sink: takes the gradient of the three in place of their `.grad`. Only on a CPU, and much faster.
    Returns:
        (N, C).
    """
    if sink is not None and weights.device.type == "cpu":
        return _Compiled.apply(weights, centers, widths, time, sink)
    ratio = (time - centers) ** 2 / (widths**2 + float(learned_basis_numba.SMALLEST_SQUARE))
    return (weights * torch.exp(-(ratio**2))).sum(1)


class _Compiled(torch.autograd.Function):
    """`value_at` without (N, B, C) tensors in between."""

    @staticmethod
    def forward(
        ctx: Any,
        weights: Tensor,
        centers: Tensor,
        widths: Tensor,
        time: float,
        sink: list[LearnedBasisGradient],
    ) -> Tensor:
        ctx.time, ctx.sink = time, sink
        arrays = [tensor.detach().numpy() for tensor in (weights, centers, widths)]
        return torch.from_numpy(learned_basis_numba.value_at(*arrays, time))

    @staticmethod
    @once_differentiable
    def backward(ctx: Any, v_value: Tensor) -> tuple[None, ...]:
        ctx.sink.append(LearnedBasisGradient(ctx.time, v_value.contiguous()))
        return None, None, None, None, None
