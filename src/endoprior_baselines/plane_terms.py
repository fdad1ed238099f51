"""Regularizers of the planes of a HexPlane field: smooth along their rows, and time planes near 1.

S = sum over planes of the mean of (p[r - 1] - 2 p[r] + p[r + 1])^2, A = sum over time planes of the mean of |1 - p|.
Rows run along the second letter of a plane's name: along time, for time planes. As in K-Planes (Fridovich-Keil et al.,
CVPR 2023) and in the code of EndoGS and Endo-4DGS.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import torch
from torch import Tensor
from torch.autograd.function import once_differentiable

from endoprior.model.hexplane import FRESH, PLANE_NAMES, TOUCHED, PlaneGrid

from . import plane_terms_numba


@dataclass(frozen=True)
class PlaneWeights:
    """Weights of the three terms."""

    space: float
    """Of S over the planes xy, xz, yz."""
    time: float
    """Of S over the planes xt, yt, zt."""
    ones: float
    """Of A."""

    def of(self, name: str) -> tuple[float, float]:
        """Weights of S and A for a plane."""
        return (self.time, self.ones) if name.endswith("t") else (self.space, 0.0)


def plane_term(grid: PlaneGrid, weights: PlaneWeights, anchor: Tensor) -> Tensor:
    """The weighted sum of the terms, (). Its backward pass adds the planes' gradient to `grid.grads`.

    Args:
        anchor: any parameter of the field that is trained; it only ties the term to the graph.
    """
    return _PlaneTerm.apply(anchor, grid, weights)


class _PlaneTerm(torch.autograd.Function):
    @staticmethod
    def forward(ctx: Any, anchor: Tensor, grid: PlaneGrid, weights: PlaneWeights) -> Tensor:
        ctx.grid, ctx.weights = grid, weights
        total = anchor.new_zeros(())
        for name, plane, _ in _planes(grid):
            total += _value(plane, *weights.of(name))
        return total

    @staticmethod
    @once_differentiable
    def backward(ctx: Any, v_value: Tensor) -> tuple[None, None, None]:
        for name, plane, gradient in _planes(ctx.grid):
            _add_gradient(plane, gradient, *ctx.weights.of(name), v_value)
        ctx.grid.marks.fill_(TOUCHED | FRESH)
        return None, None, None


def _planes(grid: PlaneGrid) -> list[tuple[str, Tensor, Tensor]]:
    """Name, values and gradient (rows, columns, C) of every plane."""
    every = [(scale, name) for scale in range(grid.num_scales) for name in PLANE_NAMES]
    return [(name, grid.plane(scale, name), grid.plane(scale, name, grid.grads)) for scale, name in every]


def _value(plane: Tensor, smooth: float, ones: float) -> Tensor:
    if plane.device.type == "cpu":
        squares, distance = plane_terms_numba.sums(plane.numpy())
    else:
        squares, distance = _second_difference(plane).square().sum(), (1 - plane).abs().sum()
    inner = max(plane[2:].numel(), 1)
    return torch.as_tensor(smooth * squares / inner + ones * distance / plane.numel(), dtype=plane.dtype)


def _add_gradient(plane: Tensor, gradient: Tensor, smooth: float, ones: float, v_value: Tensor) -> None:
    factor, pull = 2 * smooth / max(plane[2:].numel(), 1), ones / plane.numel()
    if plane.device.type == "cpu":
        plane_terms_numba.add_gradient(plane.numpy(), gradient.numpy(), factor * float(v_value), pull * float(v_value))
        return
    if len(plane) > 2:
        curve = factor * v_value * _second_difference(plane)
        gradient[:-2] += curve
        gradient[1:-1] -= 2 * curve
        gradient[2:] += curve
    gradient += pull * v_value * (plane - 1).sign()


def _second_difference(plane: Tensor) -> Tensor:
    return plane[:-2] - 2 * plane[1:-1] + plane[2:]
