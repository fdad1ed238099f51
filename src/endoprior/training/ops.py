"""The operations of training that have one implementation per kind of device: chosen once, then passed on.

`numba` runs compiled kernels on the CPU, `torch` runs wherever torch does. Both compute the same; tests compare them.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from types import ModuleType

import torch

from ..model import ops as model_ops
from . import (
    adam_numba,
    adam_torch,
    density_numba,
    density_torch,
    gradients_numba,
    gradients_torch,
    losses_numba,
    losses_torch,
    plane_adam_numba,
    temporal_numba,
    temporal_torch,
)


@dataclass(frozen=True)
class TrainingOps:
    """One implementation of each operation; the torch modules document them."""

    model: model_ops.ModelOps
    supervised_losses: Callable
    local_consistency: Callable
    add_gradient: Callable
    add_score: Callable
    valid_projection: Callable
    count_unusable: Callable
    count_unusable_in_planes: Callable
    adam_step: Callable
    adam_basis_step: Callable
    adam_planes_step: Callable


def _collect(model: model_ops.ModelOps, *modules: ModuleType) -> TrainingOps:
    """Each operation from the one of the modules that defines it."""
    found = {name: value for module in modules for name, value in vars(module).items()}
    names = [name for name in TrainingOps.__dataclass_fields__ if name != "model"]
    return TrainingOps(model, **{name: found[name] for name in names})


NUMBA = _collect(
    model_ops.NUMBA, adam_numba, plane_adam_numba, density_numba, gradients_numba, losses_numba, temporal_numba
)
TORCH = _collect(model_ops.TORCH, adam_torch, density_torch, gradients_torch, losses_torch, temporal_torch)


def ops_for(device: torch.device) -> TrainingOps:
    """The implementation that suits a device."""
    return NUMBA if device.type == "cpu" else TORCH
