"""How far frames and pixels are to be believed: M of Eq. (1) as a weight in [0, 1] in place of 0 and 1."""

from __future__ import annotations

from dataclasses import replace

import cv2
import numpy as np

from ..core.types import Frame
from ..footage.components import square
from ..footage.dark_outline import brightness

SATURATED = 250  # a pixel is saturated, and says nothing of the tissue, if its smallest channel reaches this level
SATURATED_SHARE = 0.02  # least share of tissue that is, else it is the usual highlights, which are to be modelled
GLARE_PX = 2  # so far around saturated pixels their light spreads


def weighted(frame: Frame, weight: float) -> Frame:
    """The frame with its weight on every pixel, and with 0 where much of it is saturated; itself where all are 1."""
    saturated = (~brightness(~frame.rgb_u8) >= SATURATED) & frame.tissue_mask
    glares = np.count_nonzero(saturated) > SATURATED_SHARE * max(np.count_nonzero(frame.tissue_mask), 1)
    if weight == 1 and not glares:
        return frame
    believed = np.full(frame.tissue_mask.shape, weight, np.float32)
    if glares:
        believed[cv2.dilate(saturated.astype(np.uint8), square(GLARE_PX)) > 0] = 0
    return replace(frame, weight=believed)
