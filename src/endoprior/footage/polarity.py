"""Which of a mask's two values marks tools: the smaller, grayer side that leaves most of the border to the other."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from ..core.checks import check_shape

LIT = 25
"""Darker pixels (largest channel, 0..255) say nothing: they lie outside a round border or in shadow."""
LEAST_SHARE = 0.0005
"""A side that holds less of the lit pixels than this is empty: nothing can be compared."""
AREA_WEIGHT, BORDER_WEIGHT = 4.0, 2.0
"""Log-odds per unit of area and of border: 10 % of the area speaks for tools with 5 : 1, 40 % with 1.5 : 1."""
COLOR_WEIGHT, COLOR_LIMIT = 1.5, 3.0
"""Log-odds per standard deviation between the sides' redness, and how many of those count at most."""


@dataclass(frozen=True)
class Polarity:
    """Which value marks tools, and how clear that is."""

    tool_is_high: bool
    """True where values above half mark tools."""
    certainty: float
    """0 a coin toss .. 1 certain."""
    reason: str
    """The evidence in one line."""


def mask_polarity(highs: Sequence[NDArray[np.bool_]], images: Sequence[NDArray[np.uint8]]) -> Polarity:
    """Decide which side of the masks is the tools.

    Args:
        highs: (H, W) each, True where the mask's value is above half.
        images: (H, W, 3) each, 0..255, the frames of these masks; a dozen are enough.
    Returns:
        With one side empty: tools are the smaller side, at certainty 0.
    Raises:
        ValueError: no frames, lists of unequal length, or shapes that do not match.
    """
    if not highs:
        raise ValueError("highs must hold at least one mask; got none")
    sides, reds, rims = [], [], []
    for high, image in zip(highs, images, strict=True):
        check_shape("high:H,W image:H,W,3", high=high, image=image)
        rim = np.zeros(high.shape, bool)
        rim[[0, -1]] = rim[:, [0, -1]] = True
        step = max(1, min(high.shape) // 160)  # a sample is enough, but every pixel of the border counts
        few = rim.copy()
        few[::step, ::step] = True
        few &= image.max(-1) > LIT
        color = image[few].astype(np.float64) + 10  # the offset calms the ratio of dark, noisy pixels
        reds.append(np.log(color[:, 0] / color[:, 1]))
        sides.append(high[few])
        rims.append(rim[few])
    side, redness, at_rim = (np.concatenate(parts) for parts in (sides, reds, rims))
    inner = side[~at_rim]
    area = float(inner.mean()) if inner.size else 0.0
    if not LEAST_SHARE < area < 1 - LEAST_SHARE:
        value = "high" if area > 0.5 else "low"
        return Polarity(area <= 0.5, 0.0, f"practically all pixels are {value}: the masks say nothing")
    border = float(side[at_rim].mean()) if at_rim.any() else 0.5
    high_red, low_red = (float(np.median(redness[side == value])) for value in (True, False))
    spread = np.median([np.median(np.abs(redness[side == v] - m)) for v, m in ((True, high_red), (False, low_red))])
    # 1.48 median absolute deviations are a standard deviation; 0.05 is what cameras disagree about gray.
    grayer = (low_red - high_red) / (1.48 * float(spread) + 0.05)
    log_odds = (
        AREA_WEIGHT * (0.5 - area)
        + BORDER_WEIGHT * (0.5 - border)
        + COLOR_WEIGHT * float(np.clip(grayer, -COLOR_LIMIT, COLOR_LIMIT))
    )
    reason = (
        f"high values cover {area:.0%} of the image and {border:.0%} of its border, "
        f"redness {high_red:.2f} against {low_red:.2f} elsewhere"
    )
    return Polarity(log_odds >= 0, float(np.tanh(abs(log_odds) / 2)), reason)
