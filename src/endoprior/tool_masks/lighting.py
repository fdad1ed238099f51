"""Light an example anew: another exposure and white balance, and spots where the lamp overexposes the image.

Overexposed tissue loses its red, as the red channel cannot rise further, and looks like pale metal. Clips show it in a
few places only, next to tools above all, so a network has to be taught it.

`h, w` image size. Lengths are in px of an image whose longer side is 192 px.
"""

from __future__ import annotations

import numpy as np
from numpy.random import Generator
from numpy.typing import NDArray

EXPOSURE, TINT = 0.15, 0.04
"""Standard deviation of the random exposure and of the random gain of each channel, in log units."""
WITH_SPOTS = 0.6
"""Share of the examples with bright spots, one to three."""
RADIUS_PX = (8.0, 30.0)
"""Standard deviation of a spot along its longer axis."""
GAIN = (0.45, 1.5)
"""Log of the gain in the middle of a spot."""
KNEE = 0.7
"""Level from which the camera compresses light; 1 is the clip's white, which is never exceeded."""


def exposed(rng: Generator, rgb: NDArray[np.float32]) -> NDArray[np.float32]:
    """(h, w, 3) `rgb`, where 1 is the clip's white, with another exposure and white balance."""
    return rgb * np.exp(rng.normal(0, EXPOSURE) + rng.normal(0, TINT, 3)).astype(np.float32)


def overexposed(rng: Generator, rgb: NDArray[np.float32]) -> NDArray[np.float32]:
    """(h, w, 3) `rgb` with bright spots, compressed to [0, 1] as a camera does; 1 is the clip's white."""
    if rng.random() < WITH_SPOTS:
        rgb = rgb * np.exp(_spots(rng, *rgb.shape[:2]))[..., None]
    above = np.maximum(rgb - np.float32(KNEE), 0) / np.float32(1 - KNEE)
    return np.where(above > 0, KNEE + (1 - KNEE) * (1 - np.exp(-above)), rgb).astype(np.float32)


def _spots(rng: Generator, h: int, w: int) -> NDArray[np.float32]:
    """(h, w) log gain of one to three elliptical spots; where they overlap, the brighter one counts."""
    y, x = np.mgrid[:h, :w].astype(np.float32)
    total = np.zeros((h, w), np.float32)
    for _ in range(rng.integers(1, 4)):
        dy, dx, angle = y - rng.uniform(0, h), x - rng.uniform(0, w), rng.uniform(0, np.pi)
        along, across = dx * np.cos(angle) + dy * np.sin(angle), dy * np.cos(angle) - dx * np.sin(angle)
        radius = rng.uniform(*RADIUS_PX)
        distance = (along / radius) ** 2 + (across / (radius * rng.uniform(0.4, 1))) ** 2
        total = np.maximum(total, rng.uniform(*GAIN) * np.exp(-distance / 2))
    return total.astype(np.float32)
