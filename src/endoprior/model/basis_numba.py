"""The temporal basis in Numba: reads only the few basis functions with a weight. CPU, float32 or float64."""

# pyright: reportCallIssue=false
from __future__ import annotations

import numpy as np
import torch
from numba import prange
from numpy.typing import NDArray
from torch import Tensor

from ..compute.parallel_kernels import parallel_njit
from ..compute.simd import LANES, prefetch

_CHUNK = 256  # Gaussians per task
_AHEAD = 8  # Gaussians between asking for the coefficients of one and reading them


def weighted_sum(motion: Tensor, weights: NDArray) -> Tensor:
    """See `basis.weighted_sum`."""
    coefficients = motion.contiguous().numpy()
    out = np.empty((len(coefficients), coefficients.shape[2]), dtype=coefficients.dtype)
    _weighted_sum(coefficients, weights.astype(out.dtype), *_support(weights), out)
    return torch.from_numpy(out)


def weighted_sum_backward(v_out: Tensor, weights: NDArray) -> Tensor:
    """See `basis.weighted_sum_backward`."""
    gradient = v_out.contiguous().numpy()
    v_motion = np.zeros((len(gradient), len(weights), gradient.shape[1]), dtype=gradient.dtype)
    _weighted_sum_backward(gradient, weights.astype(gradient.dtype), *_support(weights), v_motion)
    return torch.from_numpy(v_motion)


def _support(weights: NDArray) -> tuple[int, int]:
    """First basis function with a weight, and the one after the last."""
    support = np.flatnonzero(weights)
    return (int(support[0]), int(support[-1]) + 1) if len(support) else (0, 0)


@parallel_njit()
def _weighted_sum(motion, weights, first, stop, out):
    # One task per chunk of Gaussians; writes out (N, channels).
    num, channels = out.shape
    stride = motion.shape[1] * channels
    flat = motion.reshape(-1)
    for task in prange((num + _CHUNK - 1) // _CHUNK):
        for n in range(task * _CHUNK, min(num, (task + 1) * _CHUNK)):
            # Each row is read in one short piece, too short for the hardware prefetcher to foresee the next row.
            ahead = (n + _AHEAD) * stride
            for i in range(first * channels, stop * channels + LANES, LANES):
                prefetch(flat, ahead + i)
            for c in range(channels):
                out[n, c] = 0
            for b in range(first, stop):
                for c in range(channels):
                    out[n, c] += weights[b] * motion[n, b, c]


@parallel_njit()
def _weighted_sum_backward(v_out, weights, first, stop, v_motion):
    # One task per chunk of Gaussians; writes v_motion (N, B, channels) for b in [first, stop); the rest stays 0.
    num, channels = v_out.shape
    for task in prange((num + _CHUNK - 1) // _CHUNK):
        for n in range(task * _CHUNK, min(num, (task + 1) * _CHUNK)):
            for b in range(first, stop):
                for c in range(channels):
                    v_motion[n, b, c] = weights[b] * v_out[n, c]
