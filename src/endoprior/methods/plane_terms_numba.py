"""Sums and gradients of `plane_terms` in one pass over a plane each, rows in parallel. CPU, float32."""

from __future__ import annotations

import numpy as np
from numba import njit, prange
from numpy.typing import NDArray


def sums(plane: NDArray[np.float32]) -> tuple[float, float]:
    """Sum of the squared second differences along the rows, and of |1 - p|, of a plane (rows, columns, C)."""
    squares, distance = np.zeros(len(plane)), np.zeros(len(plane))
    _sums(plane.reshape(len(plane), -1), squares, distance)
    return float(squares.sum()), float(distance.sum())


def add_gradient(plane: NDArray[np.float32], gradient: NDArray[np.float32], factor: float, pull: float) -> None:
    """Add `factor` times the transposed second difference of the second differences, and `pull` times sign(p - 1)."""
    rows = len(plane)
    _add_gradient(plane.reshape(rows, -1), gradient.reshape(rows, -1), np.float32(factor), np.float32(pull))


@njit(parallel=True, cache=True)
def _sums(plane, squares, distance):
    # One task per row; writes its entry of both.
    rows, width = plane.shape
    for r in prange(rows):
        square, away = 0.0, 0.0
        for i in range(width):
            away += abs(1 - plane[r, i])
        if 0 < r < rows - 1:
            for i in range(width):
                curve = plane[r - 1, i] - 2 * plane[r, i] + plane[r + 1, i]
                square += curve * curve
        squares[r], distance[r] = square, away


@njit(parallel=True, cache=True)
def _add_gradient(plane, gradient, factor, pull):
    # One task per row; the second differences that contain a row are those at the row before, itself and the next.
    rows, width = plane.shape
    for r in prange(rows):
        for i in range(width):
            total = np.float32(0)
            if 1 < r:
                total += plane[r - 2, i] - 2 * plane[r - 1, i] + plane[r, i]
            if 0 < r < rows - 1:
                total -= 2 * (plane[r - 1, i] - 2 * plane[r, i] + plane[r + 1, i])
            if r < rows - 2:
                total += plane[r, i] - 2 * plane[r + 1, i] + plane[r + 2, i]
            away = plane[r, i] - 1
            side = np.float32(1) if away > 0 else (np.float32(-1) if away < 0 else np.float32(0))
            gradient[r, i] += factor * total + pull * side
