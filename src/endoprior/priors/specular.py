"""Highlights: pixels that are bright and pale, or clipped. `H, W` image size."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

EPSILON = 1e-6
"""Keeps the saturation of a black pixel finite."""
VALUE_THRESHOLD, SATURATION_THRESHOLD = 0.85, 0.35
"""tau_v and tau_s: a highlight is brighter than the one and paler, less saturated, than the other."""
VALUE_TEMPERATURE, SATURATION_TEMPERATURE = 0.04, 0.08
"""gamma_v and gamma_s: how gradual the two thresholds are."""
CLIP_THRESHOLD = 0.92
"""tau_o: two or more channels above it make the likelihood 1."""


def specular_likelihood(rgb: NDArray[np.floating], value_threshold: float | None = None) -> NDArray[np.float32]:
    """How likely each pixel is a highlight: bright and pale, or clipped. L^sp, paper Eq. (2).

    Does not check its input; `joint_texture_prior` does.

    Args:
        rgb: (H, W, 3) color in [0, 1].
        value_threshold: tau_v; the paper's by default.
    Returns:
        (H, W) likelihood in [0, 1]; exactly 1 where two or more channels exceed `CLIP_THRESHOLD` (strictly).
    """
    threshold = VALUE_THRESHOLD if value_threshold is None else value_threshold
    # Channel by channel: a reduction over an axis of length 3 is several times slower in NumPy.
    red, green, blue = (np.ascontiguousarray(rgb[..., c], dtype=np.float32) for c in range(3))
    value = np.maximum(np.maximum(red, green), blue)
    lowest = np.minimum(np.minimum(red, green), blue)
    saturation = (value - lowest) / (value + np.float32(EPSILON))
    bright = _sigmoid((value - np.float32(threshold)) / np.float32(VALUE_TEMPERATURE))
    pale = _sigmoid((np.float32(SATURATION_THRESHOLD) - saturation) / np.float32(SATURATION_TEMPERATURE))
    # "At least two of three above" is "the middle one above".
    middle = np.maximum(np.minimum(red, green), np.minimum(np.maximum(red, green), blue))
    return np.where(middle > np.float32(CLIP_THRESHOLD), np.float32(1), bright * pale)


def _sigmoid(x: NDArray[np.floating]) -> NDArray[np.floating]:
    """1 / (1 + exp(-x)), written with tanh so that no argument overflows."""
    return np.float32(0.5) * (np.float32(1) + np.tanh(np.float32(0.5) * x))
