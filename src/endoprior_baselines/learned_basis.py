# pyright: reportCallIssue=false
"""Functions of time that are sums of a few short basis functions, each with a weight, a center and a width of its own.

f(t) = sum_b w_b exp(-((t - c_b)^2 / (s_b^2 + 1e-4))^2). The power of 4 makes a basis function flat at its center and
end soon; the 1e-4 keeps its half width above 0.01. Yang et al., "Deform3DGS", MICCAI 2024, as released.
`N` Gaussians, `B` basis functions, `C` channels.

On a CPU, value and step of Adam are compiled. The coefficients of one Gaussian after the other are one flat row:
`LANES` of them are treated at once, whatever Gaussian, basis function and channel they belong to. At any one time most
basis functions are zero in float32, so most groups of lanes need no exponential.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from math import log2
from typing import Any

import numpy as np
import torch
from numba import njit, prange
from numpy.typing import NDArray
from torch import Tensor
from torch.autograd.function import once_differentiable
from typing_extensions import override

from endoprior.compute.parallel_kernels import parallel_njit
from endoprior.compute.simd import (
    LANES,
    broadcast,
    fma,
    largest,
    load_some,
    magnitude,
    power_of_two,
    square_root,
    store,
    store_some,
    where_ge,
)
from endoprior.model.gaussians import RankOneGradient, UnstoredGradient

COEFFICIENTS = ("basis_weights", "basis_centers", "basis_widths")
"""Names of the tensors w, c, s of the Gaussians, (N, B, C) each."""

f4 = np.float32
_MIN_SQUARE = f4(1e-4)  # added to the squared width
_REACH = f4(9.3)  # exp(-9.3^2) is below the smallest normal float32: 2^-126
_LOG2_E = f4(log2(np.e))
# Processors are slow with numbers below 1e-38, and the flank of a basis function leads there. As shares of epsilon:
_FELT = f4(0.02)  # of a gradient: less moves a coefficient by less than 1 % of the learning rate
_MOVES = f4(1e-10)  # of the first moment
_BLOCK = 8  # Gaussians treated together: their gradients stay in the nearest cache, and few lanes are left over
_CHUNK = 8  # blocks per task
_ZERO, _ONE = f4(0), f4(1)


@dataclass(frozen=True)
class LearnedBasisGradient(UnstoredGradient):
    """See `UnstoredGradient`."""

    names = COEFFICIENTS
    time: float
    v_offsets: Tensor

    @override
    @staticmethod
    def adam_step(
        gradients: Sequence[LearnedBasisGradient],
        tensors: Sequence[NDArray[np.float32]],
        firsts: Sequence[NDArray[np.float32]],
        seconds: Sequence[NDArray[np.float32]],
        rate: np.float32,
        root_scale: np.float32,
        constants: tuple[np.float32, np.float32, np.float32],
    ) -> None:
        times = np.array([gradient.time for gradient in gradients], np.float32)
        v_values = np.stack([gradient.v_offsets.numpy() for gradient in gradients])
        flat = [array.reshape(-1) for group in (tensors, firsts, seconds) for array in group]
        _adam_step(*flat, tensors[0].shape[1], times, v_values, rate, root_scale, *constants)


def value_at(
    weights: Tensor,
    centers: Tensor,
    widths: Tensor,
    time: float,
    sink: list[RankOneGradient | UnstoredGradient] | None = None,
) -> Tensor:
    """(N, C) f(t) of each Gaussian and channel, differentiable in the three coefficients.

    Args:
        weights, centers, widths: (N, B, C) w, c, s; c and s in units of the sequence, as `time`.
        time: t, in [0, 1].
        sink: takes the gradient of the three in place of their `.grad`. Only on a CPU, and much faster.
    """
    if sink is not None and weights.device.type == "cpu":
        return _Compiled.apply(weights, centers, widths, time, sink)
    ratio = (time - centers) ** 2 / (widths**2 + float(_MIN_SQUARE))
    return (weights * torch.exp(-(ratio**2))).sum(1)


class _Compiled(torch.autograd.Function):
    """`value_at` without (N, B, C) tensors in between."""

    @staticmethod
    def forward(ctx: Any, weights: Tensor, centers: Tensor, widths: Tensor, time: float, sink: list) -> Tensor:
        ctx.time, ctx.sink = time, sink
        out = np.empty((weights.shape[0], weights.shape[2]), np.float32)
        flat = (tensor.detach().numpy().reshape(-1) for tensor in (weights, centers, widths))
        _value_at(*flat, weights.shape[1], f4(time), out)
        return torch.from_numpy(out)

    @staticmethod
    @once_differentiable
    def backward(ctx: Any, v_value: Tensor) -> tuple[None, ...]:
        ctx.sink.append(LearnedBasisGradient(ctx.time, v_value.contiguous()))
        return None, None, None, None, None


@njit(forceinline=True)
def _reach(away, square):
    # Whether some lane is above 0: its ratio (t - c)^2 / square is below _REACH.
    return largest(fma(broadcast(_REACH), square, -(away * away))) > _ZERO


@njit(forceinline=True)
def _bell(ratio):
    # exp(-ratio^2), 0 from _REACH on.
    exponent = broadcast(-_LOG2_E) * ratio * ratio
    return where_ge(ratio, broadcast(_REACH), broadcast(_ZERO), power_of_two(exponent))


@njit(forceinline=True)
def _value(weights, centers, widths, time, place, lanes, held, slot):
    # Writes w exp(-ratio^2) of the coefficients from `place` on to `held` from `slot` on.
    away = broadcast(time) - load_some(centers, place, lanes)
    width = load_some(widths, place, lanes)
    square = fma(width, width, broadcast(_MIN_SQUARE))
    if _reach(away, square):
        store(held, slot, load_some(weights, place, lanes) * _bell(away * away / square))
    else:
        store(held, slot, broadcast(_ZERO))


@parallel_njit()
def _value_at(weights, centers, widths, bases, time, out):
    # One task per chunk of blocks; writes out (N, C).
    num, channels = out.shape
    row = bases * channels
    blocks = (num + _BLOCK - 1) // _BLOCK
    for task in prange((blocks + _CHUNK - 1) // _CHUNK):
        held = np.empty(_BLOCK * row + LANES, np.float32)
        for block in range(task * _CHUNK, min(blocks, (task + 1) * _CHUNK)):
            begin = block * _BLOCK
            size = (min(num, begin + _BLOCK) - begin) * row
            whole = size - size % LANES
            for i in range(0, whole, LANES):
                _value(weights, centers, widths, time, begin * row + i, None, held, i)
            if whole < size:
                _value(weights, centers, widths, time, begin * row + whole, size - whole, held, whole)
            for n in range(size // row):
                for c in range(channels):
                    out[begin + n, c] = _ZERO
                for b in range(bases):
                    for c in range(channels):
                        out[begin + n, c] += held[n * row + b * channels + c]


@njit(forceinline=True)
def _unless_below(least, value):
    # 0 where the magnitude is below `least`.
    return where_ge(magnitude(value), broadcast(least), value, broadcast(_ZERO))


@njit(forceinline=True)
def _adam(param, first, second, place, lanes, value, grad, rate, root_scale, beta1, beta2, epsilon):
    # One step of `LANES` elements whose value and gradient are known.
    grad = _unless_below(_FELT * epsilon, grad)
    m = _unless_below(
        _MOVES * epsilon, fma(broadcast(beta1), load_some(first, place, lanes), broadcast(_ONE - beta1) * grad)
    )
    v = fma(broadcast(beta2), load_some(second, place, lanes), broadcast(_ONE - beta2) * grad * grad)
    store_some(first, place, m, lanes)
    store_some(second, place, v, lanes)
    change = broadcast(rate) * m / fma(square_root(v), broadcast(root_scale), broadcast(epsilon))
    store_some(param, place, value - change, lanes)


@njit(forceinline=True)
def _step(
    w, c, s, w1, c1, s1, w2, c2, s2, times, held, place, slot, lanes, rate, root_scale, beta1, beta2, epsilon
):  # fmt: skip
    # One step of the `LANES` coefficients from `place` on; `held` (K, ...) has the gradient of the value of each.
    weight, center, width = load_some(w, place, lanes), load_some(c, place, lanes), load_some(s, place, lanes)
    square = fma(width, width, broadcast(_MIN_SQUARE))
    v_weight = v_center = v_width = broadcast(_ZERO)
    for k in range(len(times)):
        away = broadcast(times[k]) - center
        if _reach(away, square):
            ratio = away * away / square
            v_found = load_some(held[k], slot, None) * _bell(ratio)
            slope = broadcast(f4(4)) * ratio * weight * v_found / square
            v_weight = v_weight + v_found
            v_center = fma(slope, away, v_center)
            v_width = fma(slope, ratio * width, v_width)
    _adam(w, w1, w2, place, lanes, weight, v_weight, rate, root_scale, beta1, beta2, epsilon)
    _adam(c, c1, c2, place, lanes, center, v_center, rate, root_scale, beta1, beta2, epsilon)
    _adam(s, s1, s2, place, lanes, width, v_width, rate, root_scale, beta1, beta2, epsilon)


@parallel_njit()
def _adam_step(
    w, c, s, w1, c1, s1, w2, c2, s2, bases, times, v_values, rate, root_scale, beta1, beta2, epsilon
):  # fmt: skip
    # One task per chunk of blocks; changes weights, centers, widths w, c, s and their moments, flat.
    num_times, num, channels = v_values.shape
    row = bases * channels
    blocks = (num + _BLOCK - 1) // _BLOCK
    for task in prange((blocks + _CHUNK - 1) // _CHUNK):
        held = np.zeros((num_times, _BLOCK * row + LANES), np.float32)
        for block in range(task * _CHUNK, min(blocks, (task + 1) * _CHUNK)):
            begin = block * _BLOCK
            end = min(num, begin + _BLOCK)
            for k in range(num_times):
                for n in range(begin, end):
                    for b in range(bases):
                        for i in range(channels):
                            held[k, (n - begin) * row + b * channels + i] = v_values[k, n, i]
            size, place = (end - begin) * row, begin * row
            whole = size - size % LANES
            for i in range(0, whole, LANES):
                _step(
                    w, c, s, w1, c1, s1, w2, c2, s2, times, held, place + i, i, None,
                    rate, root_scale, beta1, beta2, epsilon,
                )  # fmt: skip
            if whole < size:
                _step(
                    w, c, s, w1, c1, s1, w2, c2, s2, times, held, place + whole, whole, size - whole,
                    rate, root_scale, beta1, beta2, epsilon,
                )  # fmt: skip
