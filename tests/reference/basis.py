"""The temporal basis, one function at a time."""

from __future__ import annotations

import math

from endoprior.core.config_deformation import BasisConfig


def weights(time: float, cfg: BasisConfig) -> list[float]:
    """w_b(t) = (exp(-(t - c_b)^2 / (2 s^2)) - e) / (1 - e) within three standard deviations, else 0."""
    found = []
    sigma, end = 1.5 / cfg.num_bases, math.exp(-4.5)
    for b in range(cfg.num_bases):
        center = b / (cfg.num_bases - 1)
        inside = abs(time - center) <= 3 * sigma
        found.append((math.exp(-((time - center) ** 2) / (2 * sigma**2)) - end) / (1 - end) if inside else 0.0)
    return found
