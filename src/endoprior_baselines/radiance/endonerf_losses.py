"""EndoNeRF's loss: squared error of color, and Huber's penalty of depth."""

from __future__ import annotations

import torch
from torch import Tensor
from torch.nn.functional import huber_loss

from .compositing import Composited

DEPTH_WEIGHT, HUBER_DELTA = 1.0, 0.2


def expected(view: Composited) -> Tensor:
    """(N,) depth over alpha, as the loss compares it: by way of its inverse, at most 1e6."""
    inverse = 1 / (view.depth / (view.alpha + 1e-6)).clamp(min=1e-10)
    return 1 / (inverse + 1e-6)


def color_term(color: Tensor, target: Tensor) -> Tensor:
    """Mean squared error over rays and channels (N, 3)."""
    return (color - target).square().mean()


def terms(view: Composited, color: Tensor, depth: Tensor, measured: Tensor) -> dict[str, Tensor]:
    """Weighted terms, () each.

    Without a depth, the release compares with 0, which its depth maps hold there; here such rays have color only.

    Args:
        color: (N, 3). depth: (N,) in the unit of the view's depth. measured: (N,) where it counts.
    """
    apart = huber_loss(expected(view), depth, delta=HUBER_DELTA, reduction="none")
    share = torch.where(measured, apart, torch.zeros_like(apart)).sum() / measured.sum().clamp(min=1)
    return {"color": color_term(view.color, color), "depth": DEPTH_WEIGHT * share}
