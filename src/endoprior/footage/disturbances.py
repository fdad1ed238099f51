"""What keeps an image from showing tissue as its neighbors do: smoke, blur, darkness, overexposure; and how much."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from .frame_quality import FrameQuality

REACH_S = 15.0  # an image is compared with those of its scene up to so long before and after it, s
DARK = 0.05  # mean gray level, of 1, below which an image is dark
WHITE_OUT = 0.5  # share of white pixels from which on an image is overexposed
UNFOCUSED, BLUR_RATIO = 0.3, 0.45
"""An image is blurred if its focus is below the first, or below this share of that of its neighbors."""
HAZE_RATIO, HAZE_RISE = 0.45, 0.08
"""Haze leaves less than this share of the contrast of the neighbors, and raises the floor by at least so much."""
LEAST_CONTRAST = 0.04  # of the clear neighbors; with less, haze cannot be told from smooth tissue
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
        near = near[(scene[near] == scene[i]) & (brightness[near] >= DARK) & (overexposed[near] < WHITE_OUT)]
        if brightness[i] < DARK:
            words[i], weights[i] = "dark", FLOOR_WEIGHT
        elif overexposed[i] >= WHITE_OUT:
            words[i], weights[i] = "overexposed", FLOOR_WEIGHT
        elif len(near):
            clear, usual, low = (
                float(np.percentile(each[near], share)) for each, share in ((contrast, 90), (focus, 50), (floor, 10))
            )
            if focus[i] < max(UNFOCUSED, BLUR_RATIO * usual):
                words[i], weights[i] = "blur", max(focus[i] / max(usual, 2 * UNFOCUSED), FLOOR_WEIGHT)
            elif clear >= LEAST_CONTRAST and contrast[i] < HAZE_RATIO * clear and floor[i] > low + HAZE_RISE:
                words[i], weights[i] = "smoke", max(contrast[i] / clear, FLOOR_WEIGHT)
    return words, weights


def scenes_outside(measured: Sequence[FrameQuality], scene: NDArray[np.integer]) -> set[int]:
    """The numbers of `scene` (T,) that show no inside of a body, as far as that is sure.

    Color alone does not tell: tissue can be gray or blue. It must also differ from the rest of the clip, and vary.
    """
    values = np.array(measured, np.float64).reshape(-1, len(FrameQuality._fields))
    usable = values[:, 0] >= DARK
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
