"""The operations of the model that have one implementation per kind of device: chosen once, then passed on.

`numba` runs compiled kernels on the CPU, `torch` runs wherever torch does. Both compute the same; tests compare them.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import torch
from torch import Tensor

from . import basis, basis_numba, hexplane, hexplane_numba


@dataclass(frozen=True)
class ModelOps:
    """One implementation of each operation."""

    name: str
    weighted_sum: Callable[..., Tensor]
    """Offsets from temporal coefficients: see `basis.weighted_sum`."""
    weighted_sum_backward: Callable[..., Tensor]
    """Its gradient: see `basis.weighted_sum_backward`."""
    hexplane_linear: Callable[..., tuple[Tensor, ...]]
    """A linear layer on HexPlane features: see `hexplane.hexplane_linear`."""
    fuse_heads: bool
    """Compute the hidden layers of all heads as one matrix product: fewer and larger launches on a GPU."""


NUMBA = ModelOps(
    "numba",
    basis_numba.weighted_sum,
    basis_numba.weighted_sum_backward,
    hexplane_numba.hexplane_linear,
    fuse_heads=False,
)
TORCH = ModelOps(
    "torch",
    basis.weighted_sum,
    basis.weighted_sum_backward,
    hexplane.hexplane_linear,
    fuse_heads=True,
)


def ops_for(device: torch.device) -> ModelOps:
    """The implementation that suits a device."""
    return NUMBA if device.type == "cpu" else TORCH
