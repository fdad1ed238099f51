"""Temporal basis: every Gaussian has its own coefficients for a few bumps over time. Linear, no network.

offset_i(t) = sum_b w_b(t) motion_i,b with w_b(t) = max(0, (exp(-d^2 / 2) - e) / (1 - e)), d = (t - c_b) / s and
e = exp(-3^2 / 2): a Gaussian bump, lowered by 0.011 so that it ends at three standard deviations without a jump. What
it does not reach need not be read. Centers c_b lie evenly on [0, 1], s = relative_width / B. Zero coefficients are
the identity. Bases of this kind were used per Gaussian by Yang et al., "Deform3DGS", MICCAI 2024.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Any

import numpy as np
import torch
from numba import njit, prange
from numpy.typing import NDArray
from torch import Tensor
from torch.autograd.function import once_differentiable

from ..compute.compiled import compiled
from ..compute.simd import LANES, prefetch
from ..core.checks import check_shape
from ..core.config import BasisConfig, DeformationConfig
from .deformation import Offsets, offset_names
from .heads import OUTPUT_WIDTH

REACH = 3.0
"""Half of a bump's support, in standard deviations."""
_CHUNK = 256  # Gaussians per task
_AHEAD = 8  # Gaussians between asking for the coefficients of one and reading them


def motion_layout(cfg: DeformationConfig) -> dict[str, slice]:
    """Channels of `motion` by field of `Offsets`: means, quats, log_scales, opacity_logits, sh_dc, as configured."""
    layout, start = {}, 0
    widths = {name: OUTPUT_WIDTH[name] for name in offset_names(cfg)}
    if cfg.basis.deform_color:
        widths["sh_dc"] = 3
    for name, width in widths.items():
        layout[name] = slice(start, start + width)
        start += width
    return layout


def identity_motion(num: int, cfg: DeformationConfig) -> Tensor:
    """Zero coefficients (num, B, channels) float32: Gaussians that stand still.

    Raises:
        ValueError: the config leaves B to the length of a sequence.
    """
    if cfg.basis.num_bases == 0:
        raise ValueError("num_bases must be known; got 0. Use `Config.fitted(num_frames)` first.")
    return torch.zeros(num, cfg.basis.num_bases, max(part.stop for part in motion_layout(cfg).values()))


def basis_weights(time: float, cfg: BasisConfig) -> NDArray[np.float64]:
    """(B,) weights w_b(t) of the bumps, in [0, 1]."""
    distance = time - np.linspace(0, 1, cfg.num_bases)
    sigma = cfg.relative_width / cfg.num_bases
    end = np.exp(-0.5 * REACH**2)
    return np.maximum(0.0, (np.exp(-0.5 * (distance / sigma) ** 2) - end) / (1 - end))


def weights_definition(time: Tensor, cfg: BasisConfig) -> Tensor:
    """(B,) float64 `basis_weights` of a moment () float64, where it lies: no number passes through the host."""
    centers = torch.linspace(0, 1, cfg.num_bases, dtype=torch.float64, device=time.device)
    end = math.exp(-0.5 * REACH**2)
    bump = (-0.5 * ((time - centers) * (cfg.num_bases / cfg.relative_width)).square()).exp()
    return ((bump - end) / (1 - end)).clamp(min=0)


def bases_reached(cfg: BasisConfig) -> int:
    """Most bumps that a moment can lie in; they are neighbors."""
    return min(cfg.num_bases, int(2 * REACH * cfg.relative_width * (cfg.num_bases - 1) / cfg.num_bases) + 1)


@dataclass(frozen=True)
class RankOneGradient:
    """Gradient of `motion` from one moment, weights (B,) times v_offsets (N, channels): never written out in full."""

    weights: NDArray[np.float32] | Tensor
    """A tensor where no kernel takes it."""
    v_offsets: Tensor


def basis_offsets(
    motion: Tensor, time: float | Tensor, cfg: DeformationConfig, sink: list[RankOneGradient] | None = None
) -> Offsets:
    """What `time` adds to Gaussians with coefficients `motion`.

    Args:
        motion: (N, B, channels) coefficients; channels as in `motion_layout`, those of the centers in mm.
        time: in [0, 1]; off the CPU also as a () float64 tensor.
        sink: takes the gradient of `motion` in place of `motion.grad`. One moment's gradient is an outer product, 30
            times smaller than the coefficients, and the optimizer can use it as it is.
    Returns:
        Offsets, differentiable in `motion`.
    Raises:
        ValueError: a wrong shape.
    """
    layout = motion_layout(cfg)
    check_shape(f"motion:N,{cfg.basis.num_bases},{max(part.stop for part in layout.values())}", motion=motion)
    if isinstance(time, Tensor):
        weights = weights_definition(time, cfg.basis)
    else:
        weights = basis_weights(time, cfg.basis)
    total = _WeightedSum.apply(motion, weights, sink)
    found = {name: total[:, part] for name, part in layout.items()}
    if "opacity_logits" in found:
        found["opacity_logits"] = found["opacity_logits"][:, 0]
    return Offsets(**found)


class _WeightedSum(torch.autograd.Function):
    """sum_b weights[b] * motion[:, b] over the band of weights that are not 0."""

    @staticmethod
    def forward(
        ctx: Any, motion: Tensor, weights: NDArray[np.float64] | Tensor, sink: list[RankOneGradient] | None
    ) -> Tensor:
        ctx.sink = sink
        if not compiled(motion):
            weights = torch.as_tensor(weights).to(motion.device, motion.dtype, non_blocking=True)
            ctx.weights = weights
            return torch.matmul(weights, motion.detach())
        weights = weights.astype(np.float64 if motion.dtype == torch.float64 else np.float32)
        band = np.flatnonzero(weights)
        ctx.band = (int(band[0]), int(band[-1]) + 1) if len(band) else (0, 0)
        ctx.weights, ctx.shape = weights, motion.shape
        coefficients = motion.detach().contiguous().numpy()
        out = np.empty((len(coefficients), coefficients.shape[2]), dtype=coefficients.dtype)
        _weighted_sum(coefficients, weights, *ctx.band, out)
        return torch.from_numpy(out)

    @staticmethod
    @once_differentiable
    def backward(ctx: Any, v_out: Tensor) -> tuple[Tensor | None, None, None]:
        if ctx.sink is not None:
            ctx.sink.append(RankOneGradient(ctx.weights, v_out.contiguous()))
            return None, None, None
        if not compiled(v_out):
            return v_out[:, None] * ctx.weights[:, None], None, None
        v_motion = np.zeros(ctx.shape, dtype=ctx.weights.dtype)
        _weighted_sum_backward(v_out.contiguous().numpy(), ctx.weights, *ctx.band, v_motion)
        return torch.from_numpy(v_motion), None, None


@njit(parallel=True, cache=True)
def _weighted_sum(motion, weights, first, stop, out):
    # One task per chunk of Gaussians; writes out (N, channels).
    num, channels = out.shape
    stride = motion.shape[1] * channels
    flat = motion.reshape(-1)
    for task in prange((num + _CHUNK - 1) // _CHUNK):
        for n in range(task * _CHUNK, min(num, (task + 1) * _CHUNK)):
            # What is read is a short piece of each row: too short for the processor to foresee the next one.
            ahead = (n + _AHEAD) * stride
            for i in range(first * channels, stop * channels + LANES, LANES):
                prefetch(flat, ahead + i)
            for c in range(channels):
                out[n, c] = 0
            for b in range(first, stop):
                for c in range(channels):
                    out[n, c] += weights[b] * motion[n, b, c]


@njit(parallel=True, cache=True)
def _weighted_sum_backward(v_out, weights, first, stop, v_motion):
    # One task per chunk of Gaussians; writes the band of v_motion (N, B, channels), the rest stays 0.
    num, channels = v_out.shape
    for task in prange((num + _CHUNK - 1) // _CHUNK):
        for n in range(task * _CHUNK, min(num, (task + 1) * _CHUNK)):
            for b in range(first, stop):
                for c in range(channels):
                    v_motion[n, b, c] = weights[b] * v_out[n, c]
