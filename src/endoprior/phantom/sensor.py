"""The camera model: exposure, tone curve, vignetting, sensor noise, and simulated stereo depth."""

from __future__ import annotations

import cv2
import numpy as np
from numpy.typing import NDArray

from .config import PhantomConfig

_KNEE = 0.55
"""Exposed radiance above which the tone curve bends towards white."""
_TARGET_MEDIAN = 0.15
"""Exposed radiance of the middle of the first frame; about 0.42 of full scale after the tone curve."""

_LAG_FRAMES = 4
"""Frames in which automatic gain makes up for two thirds of a change of brightness, about."""
_METER_SHARE = 0.35
"""Standard deviation of the weight with which it measures, as a share of half the width and height."""


def exposure_gain(radiance: NDArray[np.float32]) -> float:
    """The gain that maps the median of a tool-free image (H, W, 3) to the target; constant over the sequence."""
    return _TARGET_MEDIAN / max(float(np.median(radiance @ np.array([0.30, 0.59, 0.11], np.float32))), 1e-6)


def metered(radiance: NDArray[np.float32]) -> float:
    """Mean radiance of an image (H, W, 3) as automatic gain measures it: the middle counts most."""
    y, x = (np.linspace(-1, 1, size)[:, None] for size in radiance.shape[:2])
    weight = np.exp(-(y**2 + x.T**2) / (2 * _METER_SHARE**2))
    return float((radiance.mean(-1) * weight).sum() / weight.sum())


def next_gain(gain: float, measured: float, wanted: float) -> float:
    """The gain of the next frame: on its way to the one that exposes the radiance `measured` now as `wanted`."""
    return gain * (wanted / max(gain * measured, 1e-6)) ** (1 / _LAG_FRAMES)


def vignette(width: int, height: int) -> NDArray[np.float32]:
    """(H, W, 1) transmission of the lens: 1 in the center, about a third in the corners."""
    x = (np.arange(width, dtype=np.float32) + 0.5) / width
    y = ((np.arange(height, dtype=np.float32) + 0.5) / height)[:, None]
    return vignette_at(x, y)[..., None]


def vignette_at(x: NDArray, y: NDArray) -> NDArray:
    """(...) transmission at positions x, y (...), as shares of width and height."""
    x, y = x * 2 - 1, y * 2 - 1
    square = (x * x + 0.8 * y * y) / np.float32(1.8)
    return 1 - np.float32(0.68) * square**1.3


def develop(radiance: NDArray[np.float32], gain: float, shading: NDArray[np.float32]) -> NDArray[np.float32]:
    """(H, W, 3) display values in [0, 255], noise-free: gain, lens shading, soft shoulder, gamma 2.2."""
    x = radiance * (np.float32(gain) * shading)
    over = np.maximum(x - _KNEE, 0)
    x = np.minimum(x, _KNEE) + np.float32(0.47) * np.tanh(over / np.float32(0.6))
    return np.clip(x, 0, 1) ** np.float32(1 / 2.2) * np.float32(255)


def expose(display: NDArray[np.float32], noise: float, rng: np.random.Generator) -> NDArray[np.uint8]:
    """(H, W, 3) 8-bit image of `display` (H, W, 3), 0..255, with sensor noise: 8-bit levels at mid gray."""
    if noise > 0:
        grain = rng.standard_normal(display.shape, dtype=np.float32)
        # Partly correlated between channels, as after demosaicing; gamma amplifies the noise of dark pixels.
        grain = np.float32(0.8) * grain + np.float32(0.6) * grain.mean(-1, keepdims=True)
        level = np.float32(noise) * (np.float32(1.25) - np.float32(0.5 / 255) * display)
        display = display + level * grain
    return np.clip(display + 0.5, 0, 255).astype(np.uint8)


def stereo_depth(
    z: NDArray[np.float32], image: NDArray[np.uint8], cfg: PhantomConfig, rng: np.random.Generator
) -> NDArray[np.float32]:
    """Simulate stereo depth of the true depth `z` (H, W), mm; 0 where a matcher fails.

    The disparity fx * baseline / z gets a smooth error (matching windows), an independent error and steps of 1/16 px,
    all scaled to the image width. Missing: half-occluded strips left of near edges, the edges, and highlights.
    """
    unit = cfg.width / 640
    product = cfg.focal * cfg.baseline_mm
    disparity = product / z
    sigma = max(7 * unit, 0.8)
    smooth = cv2.GaussianBlur(rng.standard_normal(z.shape, dtype=np.float32), (0, 0), sigma)
    smooth *= np.float32(2 * np.sqrt(np.pi) * sigma)  # back to unit variance
    fine = rng.standard_normal(z.shape, dtype=np.float32)
    error = np.float32(cfg.depth_noise_px * unit) * (smooth * np.float32(0.95) + fine * np.float32(0.3))
    step = unit / 16
    measured = product / (np.round((disparity + error) / step) * step)
    square = np.ones((3, 3), np.uint8)
    # Next to a depth edge (steeper than a slope of 4 per pixel) matching windows cover two surfaces.
    far_edge = z - cv2.erode(z, square) > 2 + 4 * z / cfg.focal
    dilated = [cv2.dilate(where.astype(np.uint8), square) > 0 for where in (far_edge, image.min(-1) >= 246)]
    missing = dilated[0] | dilated[1] | _half_occluded(disparity)
    return np.where(missing, 0, measured).astype(np.float32)


def _half_occluded(disparity: NDArray[np.float32]) -> NDArray[np.bool_]:
    """(H, W) True where a nearer surface hides a pixel of `disparity` (H, W), px, from the right camera."""
    column = np.arange(disparity.shape[1], dtype=np.float32)
    seen_at = column - disparity
    # Nearer surfaces shift further left: a pixel is hidden when one to its right lands at or left of its own place.
    ahead = np.minimum.accumulate(seen_at[:, ::-1], 1)[:, ::-1]
    hidden = np.zeros(disparity.shape, bool)
    hidden[:, :-1] = ahead[:, 1:] < seen_at[:, :-1] - 0.5
    return hidden
