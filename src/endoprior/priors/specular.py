"""Highlights: pixels that are bright and pale, or clipped. `H, W` image size."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from ..core.config import SpecularConfig

EPSILON = 1e-6
"""Keeps the saturation of a black pixel finite."""


def specular_likelihood(rgb: NDArray[np.floating], cfg: SpecularConfig | None = None) -> NDArray[np.float32]:
    """How likely each pixel is a highlight: bright and pale, or clipped. L^sp, paper Eq. (2).

    Does not check its input; `joint_texture_prior` does.

    Args:
        rgb: (H, W, 3) color in [0, 1].
        cfg: thresholds and temperatures; the paper's by default.
    Returns:
        (H, W) likelihood in [0, 1]; exactly 1 where two or more channels exceed `clip_threshold` (strictly).
    """
    cfg = cfg or SpecularConfig()
    # Channel by channel: a reduction over an axis of length 3 is several times slower in NumPy.
    red, green, blue = (np.ascontiguousarray(rgb[..., c], dtype=np.float32) for c in range(3))
    value = np.maximum(np.maximum(red, green), blue)
    lowest = np.minimum(np.minimum(red, green), blue)
    saturation = (value - lowest) / (value + np.float32(EPSILON))
    bright = _sigmoid((value - np.float32(cfg.value_threshold)) / np.float32(cfg.value_temperature))
    pale = _sigmoid((np.float32(cfg.saturation_threshold) - saturation) / np.float32(cfg.saturation_temperature))
    # "At least two of three above" is "the middle one above".
    middle = np.maximum(np.minimum(red, green), np.minimum(np.maximum(red, green), blue))
    return np.where(middle > np.float32(cfg.clip_threshold), np.float32(1), bright * pale)


def _sigmoid(x: NDArray[np.float32]) -> NDArray[np.float32]:
    """1 / (1 + exp(-x)), written with tanh so that no argument overflows."""
    return np.float32(0.5) * (np.float32(1) + np.tanh(np.float32(0.5) * x))
