"""What moves Gaussians at one time step: offsets of their raw parameters, and the gradients of what made these offsets.

A gradient that is large, and simple to compute, is not stored: the optimizer gets what it is computed from.
"""

from __future__ import annotations

import math
from abc import ABC, abstractmethod
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any, ClassVar

import numpy as np
from numpy.typing import NDArray
from torch import Tensor

from ..core.config_deformation import DeformationConfig


@dataclass(frozen=True)
class Offsets:
    """What one time step adds to the raw parameters of N Gaussians; None where nothing is added."""

    means: Tensor
    """(N, 3) displacement of the centers, mm."""
    log_scales: Tensor | None = None
    """(N, 3)."""
    quats: Tensor | None = None
    """(N, 4), added before normalization."""
    opacity_logits: Tensor | None = None
    """(N,)."""
    sh_dc: Tensor | None = None
    """(N, 3), added to the spherical-harmonic coefficient of degree 0."""
    sh_rest: Tensor | None = None
    """(N, (D+1)**2 - 1, 3), added to those of the other degrees."""
    gloss: Tensor | None = None
    """(N, 3), added to what the right eye sees more of the color, a coefficient of degree 0."""

    @staticmethod
    def from_channels(channels: dict[str, Tensor], cfg: DeformationConfig) -> Offsets:
        """Offsets from tensors (N, width) by name, as `gaussians.offset_widths` names them; scales within bounds."""
        if "opacity_logits" in channels:
            channels["opacity_logits"] = channels["opacity_logits"][:, 0]
        if "log_scales" in channels and cfg.max_scale_change > 1:
            limit = math.log(cfg.max_scale_change)
            channels["log_scales"] = channels["log_scales"].clamp(-limit, limit)
        return Offsets(**channels)


@dataclass(frozen=True)
class RankOneGradient:
    """Gradient of temporal coefficients (N, B, C) from one time step: the outer product of two vectors.

    It is 30 times smaller than the coefficients, and the optimizer uses it in this form.
    """

    name: str
    """The tensor of the Gaussians that it is the gradient of."""
    weights: NDArray[np.float64]
    """(B,) values of the basis functions at the time."""
    v_offsets: Tensor
    """(N, C) gradient of the offsets at the time."""


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


Gradient = RankOneGradient | UnstoredGradient
"""What a time step leaves for the optimizer."""
