"""What a single image tells about how well it shows tissue: light, contrast, focus, haze, overexposure, color."""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import NamedTuple

import cv2
import numpy as np

from .components import Image, Mask, square
from .dark_outline import brightness

PIXELS = 30_000  # images are measured and matched at about this size
SEEN = 24  # level that a pixel reaches at some time, unless it lies outside of the endoscope's image
RIM_PX = 3  # width of the rim inside of that image which does not count, px
LIT = 30  # a pixel is lit if its largest channel is above this level
WHITE = 245  # a pixel is overexposed if all channels reach this level
COARSE = 40  # what is wider than this share of the image's width is no contrast of tissue


class FrameQuality(NamedTuple):
    """Measurements of one image. They are comparable within a clip, not between clips."""

    brightness: float  # mean gray level inside the endoscope's image, in [0, 1]
    contrast: float  # mean difference from the surroundings, by brightness
    focus: float  # mean second difference of neighboring pixels, by that difference: blur lowers it, haze does not
    floor: float  # level that four in five pixels exceed in every channel, by brightness: haze raises it
    overexposed: float  # share of white pixels
    red: float  # share of red in the mean color
    green: float
    hues: float  # mean difference of the red share from its median: tissue has one hue, a room has many


def small_size(width: int, height: int) -> tuple[int, int]:
    """(width, height) of the small image that is measured, px: about `PIXELS` pixels, never more than are there."""
    factor = min(1.0, math.sqrt(PIXELS / (width * height)))
    return max(round(width * factor), 1), max(round(height * factor), 1)


def view_mask(images: Sequence[Image]) -> Mask:
    """(h, w) True where some image (h, w, 3) of a clip shows something, without the rim; all True if that is little."""
    seen = np.max([brightness(image) for image in images], 0) > SEEN
    inside = cv2.erode(seen.astype(np.uint8), square(RIM_PX), borderType=cv2.BORDER_REPLICATE) > 0
    return inside if inside.mean() > 0.05 else np.ones_like(inside)


def measure_quality(small: Image, view: Mask) -> FrameQuality:
    """Measure a small image (h, w, 3), see `small_size`, inside a mask (h, w) that is True somewhere."""
    gray = cv2.cvtColor(small, cv2.COLOR_RGB2GRAY).astype(np.float32)
    lowest = ~brightness(~small)
    lit = view & (brightness(small) > LIT)
    if lit.mean() < 0.02:
        lit = view
    inner = cv2.erode(lit.astype(np.uint8), square(1)) > 0
    inner = inner if inner.any() else lit
    mean = max(float(gray[lit].mean()), 1.0)
    coarse = cv2.GaussianBlur(gray, (0, 0), max(small.shape[1] / COARSE, 1.0))
    contrast = float(np.abs(gray - coarse)[inner].mean())
    fine = float(np.abs(cv2.Laplacian(gray, cv2.CV_32F))[inner].mean())
    colors = small[lit].astype(np.float32)
    red, green, _ = (colors.mean(0) / max(float(colors.mean(0).sum()), 1.0)).tolist()
    reds = colors[:, 0] / np.maximum(colors.sum(1), 1)
    return FrameQuality(
        float(gray[view].mean()) / 255, contrast / mean, fine / max(contrast, 0.1),
        float(np.percentile(lowest[lit], 20)) / mean, float((lowest >= WHITE)[view].mean()), red, green,
        float(np.abs(reds - np.median(reds)).mean()),
    )  # fmt: skip
