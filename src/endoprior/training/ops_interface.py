"""What an implementation of the operations of training consists of: `ops.py` has the two."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

from torch import Tensor

from ..model.ops_interface import ModelOps


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
