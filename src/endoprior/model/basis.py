"""Our own way to move: temporal coefficients of each Gaussian, for cubic B-splines and for single frames.

    means_i(t) = means_i + sum_b w_b(t) motion_i,b + sum_f h_f(t) frame_motion_i,f
    other_i(t) = other_i + sum_b w'_b(t) changes_i,b         (quaternion, log scales, color; see `change_layout`)

w_b(t) = M(t K - b + 1), b = 0 .. K + 2, are the cubic B-splines of K equal spans on [0, 1] (de Boor, "A Practical Guide
to Splines", 1978), M(x) = 2/3 - x^2 + |x|^3 / 2 up to |x| = 1, (2 - |x|)^3 / 6 up to 2, else 0: four of them have a
weight at a time, their sum is 1, and the smallest eigenvalue of their Gram matrix is 0.05 of the largest, so that Adam,
which scales each coefficient on its own, reaches fast motion as soon as slow motion. h_f(t) = max(0, 1 - |t T - f|) is
1 at frame f of T and 0 at the others: what no smooth curve through the frames holds, such as the shake of a camera,
stays in the frame that shows it, and a held-out frame in between keeps to the smooth curve. Zero coefficients are the
identity. The sums over basis functions are there twice: in PyTorch for any device, and in Numba for the CPU, which
reads only the few functions with a weight.
"""

# pyright: reportCallIssue=false
from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import numpy as np
import torch
from numba import prange
from numpy.typing import NDArray
from torch import Tensor
from torch.autograd.function import once_differentiable
from typing_extensions import override

from ..compute.parallel_kernels import parallel_njit
from ..compute.simd import LANES, prefetch
from ..core.checks import check_shape
from ..core.config import Config
from ..core.config_deformation import DEGREE, BasisConfig
from .gaussians import Gaussians, Gradient, Offsets, RankOneGradient, change_layout, temporal_shapes
from .motion import Field, ModelOps, Motion

TRAINED, GIVEN = ("motion", "changes"), ("frame_motion",)
"""Tensors of `temporal_shapes` that gradients train, as outer products; and those that optical flow gives."""
FRAME_ROUNDING = 1e-9
"""Share of a frame within which a time is that of the frame: f / T, times T, may miss f by a rounding."""
_CHUNK = 256  # Gaussians per task
_AHEAD = 8  # Gaussians between asking for the coefficients of one and reading them


class BasisMotion(Motion):
    """See the module."""

    stays_at_the_ends = True  # a spline that no frame holds leads anywhere

    def tensors(self, cfg: Config) -> dict[str, tuple[int, ...]]:
        """See `Motion.tensors`."""
        return dict(temporal_shapes(cfg))

    @override
    def offsets(
        self,
        gaussians: Gaussians,
        field: Field | None,
        time: float,
        cfg: Config,
        ops: ModelOps,
        chosen: Tensor | None = None,
    ) -> Offsets:
        """See `Motion.offsets`. Unless some are chosen, the gradient goes to `gaussians.motion_gradients`."""
        rows = slice(None) if chosen is None else chosen
        sink = gaussians.motion_gradients if chosen is None else None
        return basis_offsets({name: gaussians[name][rows] for name in temporal_shapes(cfg)}, time, cfg, ops, sink)


def spline_weights(time: float, num_bases: int) -> NDArray[np.float64]:
    """(B,) values w_b(t) of B = K + 3 cubic B-splines; they sum to 1 for a time in [0, 1]."""
    distance = np.abs(time * (num_bases - DEGREE) - np.arange(num_bases) + 1)
    near = 2 / 3 - distance**2 + distance**3 / 2
    return np.where(distance < 1, near, np.maximum(2 - distance, 0) ** 3 / 6)


def frame_weights(time: float, num_frames: int) -> NDArray[np.float64]:
    """(T,) values h_f(t): 1 at the time f / T of a frame, linear between it and its neighbors, 0 from there on."""
    distance = np.abs(time * num_frames - np.arange(num_frames))
    return np.where(distance < FRAME_ROUNDING, 1.0, np.where(distance > 1 - FRAME_ROUNDING, 0.0, 1 - distance))


def basis_weights(time: float, cfg: BasisConfig) -> dict[str, NDArray[np.float64]]:
    """Values of the basis functions of `motion`, `changes` and `frame_motion` at a time."""
    return {
        "motion": spline_weights(time, cfg.num_bases),
        "changes": spline_weights(time, cfg.num_change_bases),
        "frame_motion": frame_weights(time, cfg.num_frames),
    }


def basis_offsets(
    tensors: Mapping[str, Tensor], time: float, cfg: Config, ops: ModelOps, sink: list[Gradient] | None = None
) -> Offsets:
    """Offsets at `time` of Gaussians with such coefficients; differentiable in `motion` and `changes`.

    Args:
        tensors: (N, functions, channels) by name, as `temporal_shapes` has them.
        time: in [0, 1].
        sink: takes the gradients in place of `.grad`, as outer products.
    Raises:
        ValueError: a wrong shape.
    """
    totals = {}
    weights = basis_weights(time, cfg.deformation.basis)
    for name, (functions, channels) in temporal_shapes(cfg).items():
        check_shape(f"{name}:N,{functions},{channels}", **{name: tensors[name]})
        values, taken = (tensors[name].detach(), None) if name in GIVEN else (tensors[name], sink)
        totals[name] = _WeightedSum.apply(values, name, weights[name], taken, ops)
    layout = change_layout(cfg)  # `split` has one gradient; slices have one each, of full size, to add up
    parts = totals["changes"].split([part.stop - part.start for part in layout.values()], 1)
    means = {"means": totals["motion"] + totals["frame_motion"]}
    return Offsets.from_channels(means | dict(zip(layout, parts, strict=True)), cfg.deformation)


class _WeightedSum(torch.autograd.Function):
    """sum_b weights[b] * coefficients[:, b]."""

    @staticmethod
    def forward(
        ctx: Any,
        coefficients: Tensor,
        name: str,
        weights: NDArray[np.float64],
        sink: list[Gradient] | None,
        ops: ModelOps,
    ) -> Tensor:
        ctx.name, ctx.weights, ctx.sink, ctx.ops = name, weights, sink, ops
        return ops.weighted_sum(coefficients.detach(), weights)

    @staticmethod
    @once_differentiable
    def backward(ctx: Any, v_out: Tensor) -> tuple[Tensor | None, None, None, None, None]:
        if ctx.sink is not None:
            ctx.sink.append(RankOneGradient(ctx.name, ctx.weights, v_out.contiguous()))
            return None, None, None, None, None
        return ctx.ops.weighted_sum_backward(v_out, ctx.weights), None, None, None, None


def weighted_sum(coefficients: Tensor, weights: NDArray) -> Tensor:
    """(N, C) sum_b weights[b] * coefficients[:, b] in PyTorch, on any device.

    Args:
        coefficients: (N, B, C). weights: (B,) values of the basis functions.
    """
    return torch.matmul(_like(weights, coefficients), coefficients)


def weighted_sum_backward(v_out: Tensor, weights: NDArray) -> Tensor:
    """(N, B, C) gradient of the coefficients, given that of the sum, (N, C)."""
    return v_out[:, None] * _like(weights, v_out)[:, None]


def _like(weights: NDArray, values: Tensor) -> Tensor:
    return torch.as_tensor(weights).to(values.device, values.dtype, non_blocking=True)


def weighted_sum_numba(coefficients: Tensor, weights: NDArray) -> Tensor:
    """See `weighted_sum`; float32 or float64."""
    values = coefficients.contiguous().numpy()
    out = np.empty((len(values), values.shape[2]), dtype=values.dtype)
    _weighted_sum(values, weights.astype(out.dtype), *_support(weights), out)
    return torch.from_numpy(out)


def weighted_sum_backward_numba(v_out: Tensor, weights: NDArray) -> Tensor:
    """See `weighted_sum_backward`; float32 or float64."""
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
