"""Small HexPlane grids with values that make every plane matter, and look-ups in them."""

from __future__ import annotations

from collections.abc import Callable

import torch
from torch import Tensor

from endoprior.core.config_deformation import HexPlaneConfig
from endoprior.model.hexplane import PlaneGrid
from endoprior.model.hexplane_numba import hexplane_linear


def planes(resolution: tuple[int, int, int], *values: int | tuple[int, ...]) -> HexPlaneConfig:
    """A config with other cells along x, y, z, which are 64 else; `values` are those of its fields."""
    return type("Planes", (HexPlaneConfig,), {"resolution": resolution})(*values)


SMALL = planes((5, 4, 6), 7, 20, (1, 3))


def random_grid(cfg: HexPlaneConfig = SMALL, seed: int = 0) -> PlaneGrid:
    """A grid whose time planes differ from 1 as well, so that every plane matters."""
    generator = torch.Generator().manual_seed(seed)
    grid = PlaneGrid(cfg)
    grid.values.uniform_(0.2, 1.2, generator=generator)
    return grid


def random_unit(num: int, seed: int = 1, low: float = 0.0, high: float = 1.0) -> Tensor:
    """(num, 3) positions between `low` and `high`."""
    return torch.rand(num, 3, generator=torch.Generator().manual_seed(seed)) * (high - low) + low


def random_layer(grid: PlaneGrid, width: int = 5) -> tuple[Tensor, Tensor]:
    """Weight and bias of a linear layer on the features."""
    generator = torch.Generator().manual_seed(6)
    weight = torch.randn(width, grid.num_features, generator=generator) / grid.num_features
    return weight.requires_grad_(True), torch.randn(width, generator=generator).requires_grad_(True)


def sample(
    grid: PlaneGrid, unit: Tensor, time: float, linear: Callable[..., tuple[Tensor, ...]] = hexplane_linear
) -> Tensor:
    """(N, S * C) features at one time: a linear layer that is the identity."""
    weight = torch.eye(grid.num_features, requires_grad=torch.is_grad_enabled())
    return linear(grid, unit, (time,), weight, torch.zeros(grid.num_features))[0]
