"""The operations of training that have one implementation per kind of device: chosen once, then passed on.

`NUMBA` runs compiled kernels on the CPU, `TORCH` runs wherever torch does. Both compute the same; tests compare them.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import torch
from torch import Tensor

from ..model import ops as model_ops
from ..model.motion import ModelOps
from . import adam, density_stats, local_motion, losses, tracks


@dataclass(frozen=True)
class TrainingOps:
    """One implementation of each operation; those in PyTorch document them."""

    model: ModelOps
    supervised_losses: Callable[..., Tensor]
    track_term: Callable[..., Tensor]
    local_consistency: Callable[..., tuple[Tensor, Tensor]]
    add_gradient: Callable[..., None]
    add_score: Callable[..., None]
    valid_projection: Callable[..., Tensor]
    count_unusable: Callable[..., int | Tensor]
    count_unusable_in_planes: Callable[..., int | Tensor]
    adam_step: Callable[..., None]
    adam_basis_step: Callable[..., None]
    adam_planes_step: Callable[..., None]


NUMBA = TrainingOps(
    model=model_ops.NUMBA,
    supervised_losses=losses.supervised_losses_numba,
    track_term=tracks.track_term_numba,
    local_consistency=local_motion.local_consistency_numba,
    add_gradient=density_stats.add_gradient_numba,
    add_score=density_stats.add_score_numba,
    valid_projection=density_stats.valid_projection_numba,
    count_unusable=adam.count_unusable_numba,
    count_unusable_in_planes=adam.count_unusable_in_planes_numba,
    adam_step=adam.adam_step_numba,
    adam_basis_step=adam.adam_basis_step_numba,
    adam_planes_step=adam.adam_planes_step_numba,
)
TORCH = TrainingOps(
    model=model_ops.TORCH,
    supervised_losses=losses.supervised_losses,
    track_term=tracks.track_term,
    local_consistency=local_motion.local_consistency,
    add_gradient=density_stats.add_gradient,
    add_score=density_stats.add_score,
    valid_projection=density_stats.valid_projection,
    count_unusable=adam.count_unusable,
    count_unusable_in_planes=adam.count_unusable_in_planes,
    adam_step=adam.adam_step,
    adam_basis_step=adam.adam_basis_step,
    adam_planes_step=adam.adam_planes_step,
)


def ops_for(device: torch.device) -> TrainingOps:
    """The implementation that suits a device."""
    return NUMBA if device.type == "cpu" else TORCH
