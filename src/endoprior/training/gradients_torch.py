"""Counting gradient entries that Adam must not be given, in PyTorch, on any device: the host does not wait for it."""

from __future__ import annotations

from torch import Tensor

from ..model.hexplane import PlaneGrid


def count_unusable(gradient: Tensor, limit: float) -> Tensor:
    """() entries that are NaN, infinite, or of a magnitude beyond `limit`."""
    return (~(gradient.detach().abs() <= limit)).sum()


def count_unusable_in_planes(grid: PlaneGrid, limit: float) -> Tensor:
    """`count_unusable` of the gradient of all planes of a HexPlane field."""
    return count_unusable(grid.grads, limit)
