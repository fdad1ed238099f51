"""Terms of Endo-4DGS's loss on depth: without its scale, its gradients, its normals, and weighted by confidence."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace

import torch
from torch import Tensor
from torch.nn.functional import normalize

from endoprior.core.types import RenderOutput, Splats
from endoprior.model.gaussians import SH_C0
from endoprior.render.projection import rotation_matrices

DEPTH_EPSILON = 1e-6
VARIANCE_EPSILON = 1e-12
"""Keeps the gradient of a correlation finite where a depth is flat."""
LEAST_CONFIDENCE = 1e-6
"""Confidence is at least this: its logarithm counts."""


def without_scale(depth: Tensor, counted: Tensor) -> Tensor:
    """Depth (H, W) where it counts (bool), else 0, divided by the largest there, which carries a gradient."""
    depth = depth * counted
    return depth / (depth.max() + DEPTH_EPSILON)


def gradient_correlation(depth: Tensor, target: Tensor, valid: Tensor) -> Tensor:
    """1 - Pearson's correlation of the squared gradients (dx^2 + dy^2) of two depths (H, W), ().

    Args:
        valid: (H, W) bool; a gradient counts where the pixel, the next one and the one below are valid.
    """
    counted = valid[:-1, :-1] & valid[:-1, 1:] & valid[1:, :-1]
    if int(counted.sum()) < 2:
        return depth.sum() * 0
    a, b = (_squared_gradient(values)[counted] for values in (depth, target))
    a, b = a - a.mean(), b - b.mean()
    return 1 - (a * b).sum() / (a.square().sum() * b.square().sum() + VARIANCE_EPSILON).sqrt()


def _squared_gradient(depth: Tensor) -> Tensor:
    across, down = depth[:-1, 1:] - depth[:-1, :-1], depth[1:, :-1] - depth[:-1, :-1]
    return across**2 + down**2


def normals_of_depth(depth: Tensor) -> Tensor:
    """(H, W, 3) unit vectors along (dx, -dy, -1) of a depth (H, W); the last row and column repeat those before."""
    across, down = depth[:-1, 1:] - depth[:-1, :-1], depth[1:, :-1] - depth[:-1, :-1]
    found = normalize(torch.stack([across, -down, -torch.ones_like(across)], -1), dim=-1)
    found = torch.cat([found, found[-1:]], 0)
    return torch.cat([found, found[:, -1:]], 1)


def smallest_axes(splats: Splats) -> Tensor:
    """(N, 3) the axis of each Gaussian along which it is thinnest, in world axes."""
    axes = rotation_matrices(splats.quats).transpose(1, 2)
    return axes[torch.arange(len(axes), device=axes.device), splats.scales.argmin(1)]


def normal_picture(splats: Splats, draw: Callable[[Splats], RenderOutput]) -> Tensor:
    """(H, W, 3) the thinnest axes n drawn as colors (n + 1) / 2; color of higher degrees stays in, as released."""
    first = (((smallest_axes(splats) + 1) / 2 - 0.5) / SH_C0)[:, None]
    return draw(replace(splats, sh=torch.cat([first, splats.sh[:, 1:]], 1), color_slopes=None)).color


def confident_error(value: Tensor, target: Tensor, confidence: Tensor) -> Tensor:
    """MSE / mean(2 c^2) + mean log c, (); 0 without pixels.

    Args:
        value, target: (P, C) of the pixels that count. confidence: (P,) c.
    """
    if not len(value):
        return value.sum()
    c = confidence.clamp(min=LEAST_CONFIDENCE)
    return (value - target).square().mean() / (2 * c.square()).mean() + c.log().mean()
