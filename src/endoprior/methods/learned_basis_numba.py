"""`learned_basis.value_at` in Numba: skips the basis functions that are zero in float32 at the time. CPU."""

from __future__ import annotations

import numpy as np
from numba import njit, prange
from numpy.typing import NDArray

_CHUNK = 64  # Gaussians per task
SMALLEST_SQUARE = np.float32(1e-4)
"""Added to the squared width."""
_REACH = np.float32(10.2)  # exp(-10.2^2) is below the smallest float32


def value_at(
    weights: NDArray[np.float32], centers: NDArray[np.float32], widths: NDArray[np.float32], time: float
) -> NDArray[np.float32]:
    """See `learned_basis.value_at`."""
    out = np.empty((weights.shape[0], weights.shape[2]), np.float32)
    _value_at(weights, centers, widths, np.float32(time), out)
    return out


def value_at_backward(
    weights: NDArray[np.float32],
    centers: NDArray[np.float32],
    widths: NDArray[np.float32],
    time: float,
    v_value: NDArray[np.float32],
) -> tuple[NDArray[np.float32], NDArray[np.float32], NDArray[np.float32]]:
    """Gradients of the three coefficients from that of the value, `v_value` (N, C)."""
    found = tuple(np.zeros_like(weights) for _ in range(3))
    _value_at_backward(weights, centers, widths, np.float32(time), v_value, *found)
    return found


@njit(inline="always")
def _reaches(n, b, centers, widths, time):
    # Whether basis function b of Gaussian n is above 0 at the time in any channel; one pass without branches.
    nearest = _REACH
    for c in range(centers.shape[2]):
        away = time - centers[n, b, c]
        width = widths[n, b, c]
        nearest = min(nearest, away * away / (width * width + SMALLEST_SQUARE))
    return nearest < _REACH


@njit(parallel=True, cache=True, fastmath={"nnan", "nsz"})
def _value_at(weights, centers, widths, time, out):
    # One task per chunk of Gaussians; writes out (N, C).
    num, bases, channels = weights.shape
    for task in prange((num + _CHUNK - 1) // _CHUNK):
        for n in range(task * _CHUNK, min(num, (task + 1) * _CHUNK)):
            for c in range(channels):
                out[n, c] = 0
            for b in range(bases):
                if _reaches(n, b, centers, widths, time):
                    for c in range(channels):
                        away, width = time - centers[n, b, c], widths[n, b, c]
                        ratio = away * away / (width * width + SMALLEST_SQUARE)
                        out[n, c] += weights[n, b, c] * np.exp(-ratio * ratio)


@njit(parallel=True, cache=True, fastmath={"nnan", "nsz"})
def _value_at_backward(weights, centers, widths, time, v_value, v_weights, v_centers, v_widths):
    # One task per chunk of Gaussians; writes the last three, (N, B, C), where they are not 0, as they are before.
    num, bases, channels = weights.shape
    for task in prange((num + _CHUNK - 1) // _CHUNK):
        for n in range(task * _CHUNK, min(num, (task + 1) * _CHUNK)):
            for b in range(bases):
                if _reaches(n, b, centers, widths, time):
                    for c in range(channels):
                        away, width = time - centers[n, b, c], widths[n, b, c]
                        square = width * width + SMALLEST_SQUARE
                        ratio = away * away / square
                        v_weight = v_value[n, c] * np.exp(-ratio * ratio)
                        v_ratio = -2 * ratio * weights[n, b, c] * v_weight
                        v_weights[n, b, c] = v_weight
                        v_centers[n, b, c] = v_ratio * (-2 * away / square)
                        v_widths[n, b, c] = v_ratio * (-2 * ratio * width / square)
