"""Sums and gradients of `plane_terms` in one pass over a plane each, rows in parallel. CPU, float32."""

from __future__ import annotations

import numpy as np
from numba import njit, prange
from numpy.typing import NDArray

from endoprior.compute.fastmath import REORDERED


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
