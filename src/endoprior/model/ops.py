"""The operations of the model that have one implementation per kind of device: chosen once, then passed on.

`numba` runs compiled kernels on the CPU, `torch` runs wherever torch does. Both compute the same; tests compare them.
"""

from __future__ import annotations

import torch

from . import basis, hexplane, hexplane_numba
from .motion import ModelOps

NUMBA = ModelOps(
    "numba",
    basis.weighted_sum_numba,
    basis.weighted_sum_backward_numba,
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
