"""Relative depth: what is measured in one frame fits the scene up to a scale and a shift of inverse depth.

Both are fitted to the rendered depth each time a frame is trained on, by least squares, so that the frames need not
agree with each other. `F` training frames, `P` pixels.
"""

from __future__ import annotations

from dataclasses import replace

import torch
from torch import Tensor

from ..core.types import RenderOutput
from .frames import TrainingFrame

MOMENTUM = 0.2
"""Share of a new fit in the value that is kept."""
SOLID = 0.9
"""Rendered depth counts from this opacity on."""
EVERY = 7
"""Every so many pixels take part."""
LEAST_PIXELS = 200
MOST_CHANGE = 2.0
"""A scale stays between one divided by this, and this."""
ROUNDS = 5
"""Rounds of least squares, re-weighted so that the cost is nearly that of absolute differences."""


def at_start(num_frames: int) -> Tensor:
    """(F, 2) float64 scale 1 and shift 0 of every frame."""
    return torch.tensor([[1.0, 0.0]], dtype=torch.float64).repeat(num_frames, 1)


def fitted(frame: TrainingFrame, fit: Tensor) -> TrainingFrame:
    """`frame` with its inverse depth scaled and shifted by `fit` (2,)."""
    scale, shift = (float(value) for value in fit)
    inverse = torch.where(frame.inverse_depth > 0, (scale * frame.inverse_depth + shift).clamp(min=1e-6), 0)
    return replace(frame, inverse_depth=inverse.to(frame.inverse_depth.dtype))


@torch.no_grad()
def update(fits: Tensor, position: int, frame: TrainingFrame, out: RenderOutput) -> None:
    """Move row `position` of `fits` (F, 2) towards what explains the rendered depth, and keep the mean scale at 1.

    Args:
        frame: as measured, not fitted.
    """
    counts = (frame.measured & (out.alpha > SOLID)).flatten()[::EVERY]
    measured = frame.inverse_depth.flatten()[::EVERY][counts].double()
    if len(measured) < LEAST_PIXELS:
        return
    rendered = (out.alpha / out.depth.clamp(min=1e-6)).flatten()[::EVERY][counts].double()
    found = line(measured, rendered)
    if not bool(torch.isfinite(found).all()):  # a divergence, which on a device is known some iterations later
        return
    found[0] = found[0].clamp(1 / MOST_CHANGE, MOST_CHANGE)
    fits[position] += MOMENTUM * (found.to(fits) - fits[position])
    fits /= fits[:, 0].log().mean().exp()  # only ratios between frames are to be found: the scene has its scale


def line(x: Tensor, y: Tensor) -> Tensor:
    """(2,) slope and intercept of y over x, (P,) each, by re-weighted least squares."""
    weights, found = torch.ones_like(x), x.new_tensor([1.0, 0.0])
    for _ in range(ROUNDS):
        total = weights.sum()
        mean_x, mean_y = (weights * x).sum() / total, (weights * y).sum() / total
        variance = (weights * (x - mean_x) ** 2).sum()
        slope = (weights * (x - mean_x) * (y - mean_y)).sum() / variance.clamp(min=1e-18)
        found = torch.stack([slope, mean_y - slope * mean_x])
        error = (y - found[0] * x - found[1]).abs()
        weights = 1 / error.clamp(min=1e-3 * float(y.abs().mean()))
    return found
