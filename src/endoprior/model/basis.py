"""Temporal basis: every Gaussian has its own coefficients of a few radial basis functions over time. No network.

offset_i(t) = sum_b w_b(t) motion_i,b with w_b(t) = max(0, (exp(-d^2 / 2) - e) / (1 - e)), d = (t - c_b) / s and
e = exp(-3^2 / 2): a Gaussian, lowered by 0.011 so that its support ends at three standard deviations without a jump.
Centers c_b lie evenly on [0, 1], s = relative_width / B. Zero coefficients are the identity. Yang et al., "Deform3DGS",
MICCAI 2024, use a basis of this kind per Gaussian.
"""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any, ClassVar

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor
from torch.autograd.function import once_differentiable

from ..core.checks import check_shape
from ..core.config_deformation import BasisConfig, DeformationConfig
from .attributes import motion_layout, offset_widths
from .deformation import Offsets
from .ops import ModelOps

SUPPORT = 3.0
"""Half of the support of a basis function, in standard deviations."""


def basis_weights(time: float, cfg: BasisConfig) -> NDArray[np.float64]:
    """(B,) values w_b(t) of the basis functions, in [0, 1]."""
    distance = time - np.linspace(0, 1, cfg.num_bases)
    sigma = cfg.relative_width / cfg.num_bases
    end = np.exp(-0.5 * SUPPORT**2)
    return np.maximum(0.0, (np.exp(-0.5 * (distance / sigma) ** 2) - end) / (1 - end))


class UnstoredGradient(ABC):
    """Gradient of tensors of the Gaussians at one time, never written to memory: Adam computes it as it uses it.

    For tensors so large that writing and reading their gradient costs as much as the rest of the step. CPU.
    """

    names: ClassVar[tuple[str, ...]]
    """The tensors; they have one learning rate."""
    v_offsets: Tensor
    """(N, channels) gradient of the offsets at the time."""

    @staticmethod
    @abstractmethod
    def adam_step(
        gradients: Sequence[Any],
        tensors: Sequence[NDArray[np.float32]],
        firsts: Sequence[NDArray[np.float32]],
        seconds: Sequence[NDArray[np.float32]],
        rate: np.float32,
        root_scale: np.float32,
        constants: tuple[np.float32, np.float32, np.float32],
    ) -> None:
        """One step of Adam in place, with the sum of `gradients`, all of this class.

        Args:
            tensors, firsts, seconds: the tensors as in `names`, and Adam's moments of each.
            rate: learning rate / (1 - beta1^steps). root_scale: 1 / sqrt(1 - beta2^steps).
            constants: beta1, beta2, epsilon.
        """


@dataclass(frozen=True)
class RankOneGradient:
    """Gradient of `motion` from one time step: the outer product of weights (B,) and v_offsets (N, channels)."""

    weights: NDArray[np.float64]
    v_offsets: Tensor


def basis_offsets(
    motion: Tensor, time: float, cfg: DeformationConfig, ops: ModelOps, sink: list[RankOneGradient] | None = None
) -> Offsets:
    """Offsets at `time` of Gaussians with coefficients `motion`.

    Args:
        motion: (N, B, channels) coefficients; channels as in `motion_layout`, those of the centers in mm.
        time: in [0, 1].
        sink: takes the gradient of `motion` in place of `motion.grad`. The gradient of one time step is an outer
            product, 30 times smaller than the coefficients, and the optimizer can use it in this form.
    Returns:
        Offsets, differentiable in `motion`.
    Raises:
        ValueError: a wrong shape.
    """
    layout = motion_layout(cfg)
    check_shape(f"motion:N,{cfg.basis.num_bases},{sum(offset_widths(cfg).values())}", motion=motion)
    total = _WeightedSum.apply(motion, basis_weights(time, cfg.basis), sink, ops)
    return Offsets.from_channels({name: total[:, part] for name, part in layout.items()}, cfg)


class _WeightedSum(torch.autograd.Function):
    """sum_b weights[b] * motion[:, b]."""

    @staticmethod
    def forward(
        ctx: Any, motion: Tensor, weights: NDArray[np.float64], sink: list[RankOneGradient] | None, ops: ModelOps
    ) -> Tensor:
        ctx.weights, ctx.sink, ctx.ops = weights, sink, ops
        return ops.weighted_sum(motion.detach(), weights)

    @staticmethod
    @once_differentiable
    def backward(ctx: Any, v_out: Tensor) -> tuple[Tensor | None, None, None, None]:
        if ctx.sink is not None:
            ctx.sink.append(RankOneGradient(ctx.weights, v_out.contiguous()))
            return None, None, None, None
        return ctx.ops.weighted_sum_backward(v_out, ctx.weights), None, None, None
