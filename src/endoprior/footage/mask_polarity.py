"""Which value of stored masks marks tools: of the two regions, the smaller and grayer one with less of the border."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from ..core.checks import check_shape
from .image_operations import Image, Mask

LIT = 25  # Darker pixels (largest channel, 0..255) are ignored: they are outside a round border or in shadow
MIN_LIT_REGION_SHARE = 0.0005  # A region with a smaller share of the lit pixels counts as empty
AREA_WEIGHT, BORDER_WEIGHT = 4.0, 2.0
"""Log-odds per unit of area and border: 10 % of the area gives odds of 5 : 1 for tools, 40 % gives 1.5 : 1."""
COLOR_WEIGHT, COLOR_LIMIT = 1.5, 3.0
"""Log-odds per standard deviation of the redness difference, and its limit in standard deviations."""


@dataclass(frozen=True)
class Polarity:
    """The value that marks tools, and the certainty of the detection."""

    tool_is_high: bool  # True where values above half mark tools
    certainty: float  # From 0 (unknown) to 1 (certain)
    reason: str  # The measurements in one line


def mask_polarity(highs: Sequence[Mask], images: Sequence[Image]) -> Polarity:
    """Detect which value of the masks marks tools; if one does not occur, that one, with certainty 0. `highs` (H, W)
    are True where the mask's value is above half, `images` (H, W, 3) their frames; a dozen are enough.
    """
    if not highs:
        raise ValueError("highs must hold at least one mask, got none")
    sides, reds, rims = [], [], []
    for high, image in zip(highs, images, strict=True):
        check_shape("high:H,W image:H,W,3", high=high, image=image)
        rim = np.zeros(high.shape, bool)
        rim[[0, -1]] = rim[:, [0, -1]] = True
        step = max(1, min(high.shape) // 160)  # subsample the interior, but use every border pixel
        few = rim.copy()
        few[::step, ::step] = True
        few &= image.max(-1) > LIT
        color = image[few].astype(np.float64) + 10  # the offset stabilizes the ratio of dark, noisy pixels
        reds.append(np.log(color[:, 0] / color[:, 1]))
        sides.append(high[few])
        rims.append(rim[few])
    side, redness, at_rim = (np.concatenate(parts) for parts in (sides, reds, rims))
    inner = side[~at_rim]
    area = float(inner.mean()) if inner.size else 0.0
    if not MIN_LIT_REGION_SHARE < area < 1 - MIN_LIT_REGION_SHARE:
        value = "high" if area > 0.5 else "low"
        return Polarity(area <= 0.5, 0.0, f"almost all pixels are {value}: polarity unknown")
    border = float(side[at_rim].mean()) if at_rim.any() else 0.5
    high_red, low_red = (float(np.median(redness[side == value])) for value in (True, False))
    deviation = np.median([np.median(np.abs(redness[side == v] - m)) for v, m in ((True, high_red), (False, low_red))])
    # 1.48 median absolute deviations are a standard deviation; 0.05 is the variation of gray between cameras.
    grayer = (low_red - high_red) / (1.48 * float(deviation) + 0.05)
    by_color = COLOR_WEIGHT * float(np.clip(grayer, -COLOR_LIMIT, COLOR_LIMIT))
    log_odds = AREA_WEIGHT * (0.5 - area) + BORDER_WEIGHT * (0.5 - border) + by_color
    reason = (
        f"high values cover {area:.0%} of the image and {border:.0%} of its border, "
        f"redness {high_red:.2f} against {low_red:.2f} elsewhere"
    )
    return Polarity(log_odds >= 0, float(np.tanh(abs(log_odds) / 2)), reason)
