"""What tells a tool that was clicked from tissue: the network's log-odds, color and local contrast of each pixel.

Features of the network's decoder were tried, too: on tools that it misses they do no better than these.
`h, w` is the size of the network's image.
"""

from __future__ import annotations

import cv2
import numpy as np
from numpy.typing import NDArray

SURE = 4.0
"""Log-odds count up to this, so that examples can outweigh a network that is sure and wrong."""
COLORS = 5
"""Channels of the network's image: color, two color ratios."""
SMOOTH_PX, CONTRAST_PX = 1.0, 2.0
"""Standard deviations of the windows of color and contrast."""
LEAST_CONTRAST = 0.02
"""Added before the logarithm: about the noise of a color of [-1, 1]."""
LOOK = slice(0, 1 + COLORS)
"""The features by which a region of one tool is told from what is beside it: all but the contrast."""


def feature_map(log_odds: NDArray[np.float32], image: NDArray[np.float32]) -> NDArray[np.float32]:
    """(h, w, 7) clipped log-odds, smoothed color, log of the local contrast.

    Args:
        log_odds: (h, w) of the network.
        image: (6, h, w) of `network_input`.
    """
    gray = image[:3].mean(0)
    mean, square = (cv2.GaussianBlur(each, (0, 0), CONTRAST_PX) for each in (gray, gray * gray))
    contrast = np.log(np.sqrt(np.maximum(square - mean * mean, 0)) + np.float32(LEAST_CONTRAST))
    color = [cv2.GaussianBlur(channel, (0, 0), SMOOTH_PX) for channel in image[:COLORS]]
    return np.stack([np.clip(log_odds, -SURE, SURE), *color, contrast], -1).astype(np.float32)
