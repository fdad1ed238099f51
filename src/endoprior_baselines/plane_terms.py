# pyright: reportCallIssue=false
"""Regularizers of the planes of a HexPlane field: smooth along their rows, and time planes near 1.

S = sum over planes of the mean of (p[r - 1] - 2 p[r] + p[r + 1])^2, A = sum over time planes of the mean of |1 - p|.
Rows run along the second letter of a plane's name: along time, for time planes. As in K-Planes (Fridovich-Keil et al.,
CVPR 2023) and in the code of EndoGS and Endo-4DGS. On a CPU one compiled pass over a plane each, rows in parallel.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
import torch
from numba import prange
from torch import Tensor
from torch.autograd.function import once_differentiable

from endoprior.compute.parallel_kernels import parallel_njit
from endoprior.compute.simd import REORDERED
from endoprior.model.hexplane import FRESH, PLANE_NAMES, TOUCHED, PlaneGrid
from endoprior.training.state import ForwardPass
from endoprior.training.trainer import Stage


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


def planes_of(forward: ForwardPass, weights: PlaneWeights) -> dict[str, Tensor]:
    """`plane_term` by name, of the field that moved the Gaussians; nothing in the coarse stage."""
    if forward.stage is not Stage.FINE:
        return {}
    assert forward.field is not None and forward.field.grid is not None
    return {"planes": plane_term(forward.field.grid, weights, next(iter(forward.field.parameters.values())))}


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
        sums = np.zeros((2, len(plane)))
        _sums(plane.numpy().reshape(len(plane), -1), *sums)
        squares, distance = (float(of_rows.sum()) for of_rows in sums)
    else:
        squares, distance = _second_difference(plane).square().sum(), (1 - plane).abs().sum()
    inner = max(plane[2:].numel(), 1)
    return torch.as_tensor(smooth * squares / inner + ones * distance / plane.numel(), dtype=plane.dtype)


def _add_gradient(plane: Tensor, gradient: Tensor, smooth: float, ones: float, v_value: Tensor) -> None:
    """Add the transposed second difference of the second differences, and the sign of p - 1, each with its factor."""
    factor, pull = 2 * smooth / max(plane[2:].numel(), 1), ones / plane.numel()
    if plane.device.type == "cpu":
        flat = (each.numpy().reshape(len(plane), -1) for each in (plane, gradient))
        _add_rows(*flat, np.float32(factor * float(v_value)), np.float32(pull * float(v_value)))
        return
    if len(plane) > 2:
        curve = factor * v_value * _second_difference(plane)
        gradient[:-2] += curve
        gradient[1:-1] -= 2 * curve
        gradient[2:] += curve
    gradient += pull * v_value * (plane - 1).sign()


def _second_difference(plane: Tensor) -> Tensor:
    return plane[:-2] - 2 * plane[1:-1] + plane[2:]


@parallel_njit(fastmath=REORDERED)
def _sums(plane, squares, distance):
    # One task per row; writes its entry of both.
    rows, width = plane.shape
    for r in prange(rows):
        square, away = np.float32(0), np.float32(0)
        for i in range(width):
            away += abs(1 - plane[r, i])
        if 0 < r < rows - 1:
            before, here, after = plane[r - 1], plane[r], plane[r + 1]
            for i in range(width):
                curve = before[i] - 2 * here[i] + after[i]
                square += curve * curve
        squares[r], distance[r] = square, away


@parallel_njit()
def _add_rows(plane, gradient, factor, pull):
    # One task per row. The second differences that contain a row are those at the row before, itself and the next;
    # the rows that these read have weights 1, -4, 6, -4, 1 where all three are there.
    rows, width = plane.shape
    for r in prange(rows):
        before = np.float32(1 < r)
        here = np.float32(0 < r < rows - 1)
        after = np.float32(r < rows - 2)
        far_back, back = factor * before, -2 * factor * (before + here)
        middle = factor * (before + 4 * here + after)
        ahead, far_ahead = -2 * factor * (here + after), factor * after
        a, b, c = plane[max(r - 2, 0)], plane[max(r - 1, 0)], plane[r]
        d, e, into = plane[min(r + 1, rows - 1)], plane[min(r + 2, rows - 1)], gradient[r]
        for i in range(width):
            into[i] += far_back * a[i] + back * b[i] + middle * c[i] + ahead * d[i] + far_ahead * e[i]
        if pull:
            for i in range(width):
                into[i] += pull * (np.float32(c[i] > 1) - np.float32(c[i] < 1))
