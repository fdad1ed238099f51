"""What an implementation of the model's operations consists of: `ops.py` has the two."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

from torch import Tensor


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
