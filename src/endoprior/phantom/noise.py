# pyright: reportCallIssue=false
"""Procedural noise on arbitrary coordinates: smooth fractal noise and cellular borders, both functions of a seed.

Each output element depends only on its own coordinates, so results do not depend on the number of threads.
"""

from __future__ import annotations

import numpy as np
from numba import njit, prange
from numpy.typing import NDArray

from ..compute.parallel_kernels import parallel_njit
from ..compute.simd import REORDERED


@njit(cache=True, inline="always")
def _hash(ix, iy, seed):
    # Mixes two lattice indices into 32 bits; int64 arithmetic with masks, so no platform-dependent overflow.
    h = (ix * 374761393 + iy * 668265263 + seed * 974634777) & 0xFFFFFFFF
    h = ((h ^ (h >> 13)) * 1274126177) & 0xFFFFFFFF
    h = ((h ^ (h >> 15)) * 739982445) & 0xFFFFFFFF
    return h ^ (h >> 16)


@njit(cache=True)
def _corner(ix, iy, seed, dx, dy):
    # Ramp of one lattice point: its pseudo-random gradient times the offset (dx, dy) from it.
    h = _hash(ix, iy, seed)
    gx = np.float32(h & 0xFFFF) * np.float32(1 / 32768) - np.float32(1)
    gy = np.float32((h >> 16) & 0xFFFF) * np.float32(1 / 32768) - np.float32(1)
    return gx * dx + gy * dy


@parallel_njit(fastmath=REORDERED)
def _fractal(x, y, octaves, seed, out):
    # One task per row of x, y, out (H, W). Gradient noise with a quintic fade; octave k has frequency 2^k, weight 2^-k.
    for i in prange(x.shape[0]):
        for j in range(x.shape[1]):
            total, weight, px, py = np.float32(0), np.float32(1), x[i, j], y[i, j]
            for k in range(octaves):
                ix, iy = int(np.floor(px)), int(np.floor(py))
                dx, dy = px - np.float32(ix), py - np.float32(iy)
                one = np.float32(1)
                sx = dx * dx * dx * (dx * (dx * np.float32(6) - np.float32(15)) + np.float32(10))
                sy = dy * dy * dy * (dy * (dy * np.float32(6) - np.float32(15)) + np.float32(10))
                n00, n10 = _corner(ix, iy, seed + k, dx, dy), _corner(ix + 1, iy, seed + k, dx - one, dy)
                n01 = _corner(ix, iy + 1, seed + k, dx, dy - one)
                n11 = _corner(ix + 1, iy + 1, seed + k, dx - one, dy - one)
                top, bottom = n00 + sx * (n10 - n00), n01 + sx * (n11 - n01)
                total += weight * (top + sy * (bottom - top))
                weight *= np.float32(0.5)
                px, py = px * np.float32(2), py * np.float32(2)
            out[i, j] = total


@parallel_njit(fastmath=REORDERED)
def _cells(x, y, seed, out):
    # One task per row. Difference between the distances to the second and the first nearest jittered lattice point.
    for i in prange(x.shape[0]):
        for j in range(x.shape[1]):
            ix, iy = int(np.floor(x[i, j])), int(np.floor(y[i, j]))
            first, second = np.float32(9), np.float32(9)
            for cy in range(iy - 1, iy + 2):
                for cx in range(ix - 1, ix + 2):
                    h = _hash(cx, cy, seed)
                    dx = np.float32(cx) + np.float32(h & 0xFFFF) * np.float32(1 / 65536) - x[i, j]
                    dy = np.float32(cy) + np.float32((h >> 16) & 0xFFFF) * np.float32(1 / 65536) - y[i, j]
                    distance = np.sqrt(dx * dx + dy * dy)
                    if distance < first:
                        first, second = distance, first
                    elif distance < second:
                        second = distance
            out[i, j] = second - first


def fractal(x: NDArray, y: NDArray, octaves: int, seed: int) -> NDArray[np.float32]:
    """(H, W) smooth noise of zero mean, roughly in [-1, 1], with features one unit of `x, y` (H, W) wide."""
    out = np.empty(x.shape, np.float32)
    _fractal(x.astype(np.float32), y.astype(np.float32), octaves, seed * 16, out)
    return out


def cells(x: NDArray, y: NDArray, seed: int) -> NDArray[np.float32]:
    """(H, W) in [0, ~1.5]: 0 on the borders between cells about one unit of `x, y` wide, large inside them."""
    out = np.empty(x.shape, np.float32)
    _cells(x.astype(np.float32), y.astype(np.float32), seed, out)
    return out
