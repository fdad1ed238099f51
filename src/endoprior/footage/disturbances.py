"""What an image tells about how well it shows tissue, and what keeps it from showing tissue as its neighbors do."""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import NamedTuple

import cv2
import numpy as np
from numpy.typing import NDArray

from .image_operations import Image, Mask, largest_channel, smallest_channel, square

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
    seen = np.max([largest_channel(image) for image in images], 0) > SEEN
    inside = cv2.erode(seen.astype(np.uint8), square(RIM_PX), borderType=cv2.BORDER_REPLICATE) > 0
    return inside if inside.mean() > 0.05 else np.ones_like(inside)


def measure_quality(small: Image, view: Mask) -> FrameQuality:
    """Measure a small image (h, w, 3), see `small_size`, inside a mask (h, w) that is True somewhere."""
    gray = cv2.cvtColor(small, cv2.COLOR_RGB2GRAY).astype(np.float32)
    lowest = smallest_channel(small)
    lit = view & (largest_channel(small) > LIT)
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


REACH_S = 15.0  # an image is compared with those of its scene up to so long before and after it, s
DARK_MEAN_GRAY = 0.05  # mean gray level, of 1, below which an image is dark
WHITE_OUT = 0.5  # share of white pixels from which on an image is overexposed
UNFOCUSED, BLUR_RATIO = 0.3, 0.45
"""An image is blurred if its focus is below the first, or below this share of that of its neighbors."""
HAZE_RATIO, HAZE_RISE = 0.45, 0.08
"""Haze leaves less than this share of the contrast of the neighbors, and raises the floor by at least so much."""
MIN_CONTRAST = 0.04  # of the clear neighbors; with less, haze cannot be told from smooth tissue
RED, GRAY, COLD, GREEN, APART, HUES = 0.08, 0.03, -0.03, 0.325, 0.08, 1.15
"""The inside of a body is redder than its next color by the first. A scene is outside if that excess is below the
second, its share of green is above the fourth, its shares differ by the fifth from those of the clip, and it has more
hues than the clip by a factor, the sixth, or the excess is even below the third."""
FLOOR_WEIGHT = 0.1  # a disturbed image keeps at least this weight: its pose may be known


def disturbances(
    seconds: NDArray[np.float64], measured: Sequence[FrameQuality], scene: NDArray[np.integer]
) -> tuple[list[str], NDArray[np.float64]]:
    """A word for what is wrong with each image, empty for nothing, and how far it is to be believed, in [0, 1].

    Args:
        seconds: (T,) ascending. measured: of T images. scene: (T,) a number for each scene.
    """
    values = np.array(measured, np.float64).reshape(-1, len(FrameQuality._fields))
    brightness, contrast, focus, floor, overexposed, *_ = values.T
    words, weights = [""] * len(values), np.ones(len(values))
    for i, time in enumerate(seconds):
        first, end = np.searchsorted(seconds, [time - REACH_S, time + REACH_S], side="left")
        near = np.arange(first, end)
        near = near[(scene[near] == scene[i]) & (brightness[near] >= DARK_MEAN_GRAY) & (overexposed[near] < WHITE_OUT)]
        if brightness[i] < DARK_MEAN_GRAY:
            words[i], weights[i] = "dark", FLOOR_WEIGHT
        elif overexposed[i] >= WHITE_OUT:
            words[i], weights[i] = "overexposed", FLOOR_WEIGHT
        elif len(near):
            clear, usual, low = (
                float(np.percentile(each[near], share)) for each, share in ((contrast, 90), (focus, 50), (floor, 10))
            )
            if focus[i] < max(UNFOCUSED, BLUR_RATIO * usual):
                words[i], weights[i] = "blur", max(focus[i] / max(usual, 2 * UNFOCUSED), FLOOR_WEIGHT)
            elif clear >= MIN_CONTRAST and contrast[i] < HAZE_RATIO * clear and floor[i] > low + HAZE_RISE:
                words[i], weights[i] = "smoke", max(contrast[i] / clear, FLOOR_WEIGHT)
    return words, weights


def scenes_outside(measured: Sequence[FrameQuality], scene: NDArray[np.integer]) -> set[int]:
    """The numbers of `scene` (T,) that show no inside of a body, as far as that is sure.

    Color alone does not tell: tissue can be gray or blue. It must also differ from the rest of the clip, and vary.
    """
    values = np.array(measured, np.float64).reshape(-1, len(FrameQuality._fields))
    usable = values[:, 0] >= DARK_MEAN_GRAY
    if not usable.any():
        return set()
    red, green, hues = values[:, 5:8].T
    excess = red - np.maximum(green, 1 - red - green)
    usual = np.median(values[usable, 5:8], 0)
    found = set[int]()
    for number in np.unique(scene[usable]):
        of = usable & (scene == number)
        apart = np.abs(np.median(values[of, 5:7], 0) - usual[:2]).max()
        red_by = float(np.median(excess[of]))
        is_other = red_by < GRAY and np.median(green[of]) > GREEN and np.median(excess[usable]) > RED and apart > APART
        if is_other and (red_by < COLD or np.median(hues[of]) > HUES * usual[2]):
            found.add(int(number))
    return found
