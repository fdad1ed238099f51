"""HexPlane by its definition, which any device but the CPU runs: it agrees with the kernels."""

from __future__ import annotations

from contextlib import nullcontext

import pytest
import torch
from test_hexplane import random_grid, random_layer, random_unit

from endoprior.compute.compiled import definitions_only
from endoprior.core.config import HexPlaneConfig


@pytest.mark.parametrize("time_map", ["raw", "full"])
def test_the_definition_agrees_with_the_kernels(time_map: str) -> None:
    """Two moments at once: values, gradients of positions, planes and layer."""
    cfg, times = HexPlaneConfig((5, 4, 6), 7, 20, (1, 3), time_map=time_map), (0.2, 0.93)
    found = []
    for switch in (nullcontext, definitions_only):
        with switch():
            grid = random_grid(cfg)
            unit = random_unit(150, 3, -0.2, 1.2).requires_grad_(True)
            weight, bias = random_layer(grid)
            out = torch.stack(grid.linear(unit, times, weight, bias))
            (out * torch.randn(out.shape, generator=torch.Generator().manual_seed(1))).sum().backward()
            sample = grid.sample(unit.detach(), 0.4)
            sample.square().sum().backward()
            found.append([out, unit.grad, weight.grad, bias.grad, grid.grads, sample])
    for ours, theirs in zip(*found, strict=True):
        torch.testing.assert_close(ours, theirs, rtol=1e-4, atol=1e-4 * float(theirs.detach().abs().max()))


def test_the_definition_survives_positions_without_a_value() -> None:
    grid, unit = random_grid(), torch.full((3, 3), float("nan"))
    with definitions_only(), torch.no_grad():
        assert grid.sample(unit, 0.3).isnan().all()
