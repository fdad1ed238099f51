"""Blood on the tissue: pools in the creases and streaks over them, glossy and dark; it moves with the tissue."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from .noise import fractal
from .surface import Organs, soften

_INK = np.array([0.125, 0.0045, 0.0035], np.float32)
"""Linear color of deep blood."""
_POOLED = 0.72
"""Share of the blood that lies in pools; the rest is in streaks."""


def blood_depth(
    organs: Organs, a: NDArray, b: NDArray, mm_per_texel: float, seed: int, share: float
) -> NDArray[np.float32]:
    """(TH, TW) in [0, 1]: how deep the blood is, at plane points `a, b` (TH, TW), mm; above 0 on about `share`."""
    sunken = soften(organs.height, mm_per_texel, 5.0) - organs.height
    pools = fractal(a / 13, b / 13, 3, seed + 40) + 0.16 * np.clip(sunken, -3, 4)
    # Streaks run down the image, winding.
    aside = a + 4 * fractal(a / 15, b / 15, 2, seed + 41)
    streaks = fractal(aside / 3.2, b / 26, 2, seed + 42) + 0.5 * fractal(a / 22, b / 22, 1, seed + 43)
    deep = _above(pools, _POOLED * share, 0.34)
    thin = 0.6 * _above(streaks, (1 - _POOLED) * share, 0.30)
    return np.maximum(deep, thin).astype(np.float32)


def _above(field: NDArray, share: float, width: float) -> NDArray:
    """In [0, 1]: 0 below the level that `share` of the field exceeds, rising to 1 within `width` above it."""
    level = np.quantile(field[::4, ::4], 1 - share)
    return np.clip((field - level) / width, 0, 1)


def bled(
    albedo: NDArray[np.float32], relief: NDArray, wet: NDArray, depth: NDArray[np.float32]
) -> tuple[NDArray[np.float32], NDArray, NDArray]:
    """The tissue's maps under blood: linear color (TH, TW, 3), fine height (TH, TW), mm, and wetness (TH, TW).

    Args:
        depth: (TH, TW) from `blood_depth`.
    """
    opaque = (1 - np.exp(-3.5 * depth))[..., None]
    # A film stains what is below it; depth hides it.
    stained = albedo * np.array([0.80, 0.22, 0.20], np.float32)
    color = albedo + np.minimum(3 * depth, 1)[..., None] * (stained - albedo)
    color = color + opaque * (_INK - color)
    covered = np.minimum(3 * depth, 1)
    # The surface is smooth, and rises from its rim.
    smooth = relief * (1 - 0.85 * covered) + 0.35 * np.sqrt(depth)
    return color.astype(np.float32), smooth, wet + covered * (1.35 - wet)
