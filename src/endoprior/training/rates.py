"""Learning rates and their schedules, as the config says them."""

from __future__ import annotations

import math
from collections.abc import Callable

import numpy as np
from numpy.typing import NDArray

from ..core.config import Config, OptimConfig
from ..model.attributes import ATTRIBUTES, motion_layout

Rate = Callable[[int], float]
"""Learning rate at an iteration (1-based, within the stage)."""
PLANES = "planes"
"""Name of the planes of a field, among the names of parameters."""
LATE = 0.75
"""Share of `decay_iterations` after which the rates without a final value begin to fall."""


def log_linear(start: float, end: float, iteration: int, steps: int) -> float:
    """Learning rate that falls from `start` to `end` over `steps` iterations, linearly in its logarithm, then holds."""
    share = min(max(iteration / steps, 0.0), 1.0)
    return math.exp(math.log(start) * (1 - share) + math.log(end) * share)


def late_share(optim: OptimConfig, iteration: int) -> float:
    """Share of a rate without a final value that is left at an iteration: see `OptimConfig.late_decay`."""
    begin = round(LATE * optim.decay_iterations)
    return log_linear(1.0, optim.late_decay, iteration - begin, max(optim.decay_iterations - begin, 1))


def rate_of(name: str, cfg: Config, spatial_scale: float) -> Rate:
    """Rate of an attribute of the Gaussians, of a field's planes or box, or else of its network.

    A rate with a final value is a length, so `spatial_scale` multiplies it, and decays all along; the others decay
    late.
    """
    fields = {a.name: a.rate for a in ATTRIBUTES} | {PLANES: "planes_lr", "box": "planes_lr"}
    field, optim = fields.get(name, "network_lr"), cfg.optim
    start, end = getattr(optim, field), getattr(optim, f"{field}_final", None)
    if end is None:
        return lambda iteration: start * late_share(optim, iteration)
    return lambda iteration: spatial_scale * log_linear(start, end, iteration, optim.decay_iterations)


def motion_rates(cfg: Config, iteration: int) -> NDArray:
    """(C,) learning rate of each channel of the temporal coefficients."""
    decay = log_linear(1.0, cfg.optim.basis_decay, iteration, cfg.optim.decay_iterations)
    rates = {a.name: getattr(cfg.optim, a.basis_rate) for a in ATTRIBUTES if a.basis_rate}
    layout = motion_layout(cfg.deformation)
    return np.concatenate([np.full(part.stop - part.start, rates[name] * decay) for name, part in layout.items()])
