"""Sums and gradients of `plane_terms` in one pass over a plane each, rows in parallel. CPU, float32."""

from __future__ import annotations

import numpy as np
from numba import njit, prange
from numpy.typing import NDArray

from ..compute.fastmath import REORDERED


def sums(plane: NDArray[np.float32]) -> tuple[float, float]:
    """Sum of the squared second differences along the rows, and of |1 - p|, of a plane (rows, columns, C)."""
    squares, distance = np.zeros(len(plane)), np.zeros(len(plane))
    _sums(plane.reshape(len(plane), -1), squares, distance)
    return float(squares.sum()), float(distance.sum())


def add_gradient(plane: NDArray[np.float32], gradient: NDArray[np.float32], factor: float, pull: float) -> None:
    """Add `factor` times the transposed second difference of the second differences, and `pull` times sign(p - 1)."""
    rows = len(plane)
    _add_gradient(plane.reshape(rows, -1), gradient.reshape(rows, -1), np.float32(factor), np.float32(pull))


@njit(parallel=True, cache=True, fastmath=REORDERED)
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


@njit(parallel=True, cache=True)
def _add_gradient(plane, gradient, factor, pull):
    # One task per row; the second differences that contain a row are those at the row before, itself and the next.
    rows, width = plane.shape
    for r in prange(rows):
        into, here = gradient[r], plane[r]
        if 1 < r:
            first, second = plane[r - 2], plane[r - 1]
            for i in range(width):
                into[i] += factor * (first[i] - 2 * second[i] + here[i])
        if 0 < r < rows - 1:
            first, second = plane[r - 1], plane[r + 1]
            for i in range(width):
                into[i] -= 2 * factor * (first[i] - 2 * here[i] + second[i])
        if r < rows - 2:
            first, second = plane[r + 1], plane[r + 2]
            for i in range(width):
                into[i] += factor * (here[i] - 2 * first[i] + second[i])
        if pull:
            for i in range(width):
                into[i] += pull * np.sign(here[i] - 1)
