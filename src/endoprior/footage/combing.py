"""Combed images: rows of two times in one image, of an interlaced video that its file does not flag as such."""

from __future__ import annotations

from collections.abc import Sequence

import cv2
import numpy as np
from numpy.typing import NDArray

BLOCK_PX = 16
LEAST_DIFFERENCE = 3.0
"""Mean difference of neighboring rows, of 255, above which a block has structure."""
RATIO = 1.3
"""A block is combed if its neighboring rows differ more than rows two apart, by this factor; usually it is 0.55."""
SHARE = 0.1
"""Least share of combed blocks, of those with structure. Progressive clips have up to 0.03, woven ones 0.07 to 1."""
LEAST_BLOCKS = 8
LEAST_IMAGES = 0.1
"""Share of images that must be combed: without motion there is nothing to see."""


def is_combed(rgb_u8: NDArray[np.uint8]) -> bool:
    """Whether moving parts of an image (H, W, 3) alternate from row to row."""
    gray = cv2.cvtColor(rgb_u8, cv2.COLOR_RGB2GRAY).astype(np.float32)
    height, width = ((side - 2) // BLOCK_PX * BLOCK_PX for side in gray.shape)
    if min(height, width) < BLOCK_PX:
        return False
    next_row, next_but_one = (
        np.abs(gray[by : height + by, :width] - gray[:height, :width])
        .reshape(height // BLOCK_PX, BLOCK_PX, width // BLOCK_PX, BLOCK_PX)
        .mean((1, 3))
        for by in (1, 2)
    )
    structured = next_row > LEAST_DIFFERENCE
    combed = structured & (next_row > RATIO * next_but_one)
    return bool(combed.sum() >= max(LEAST_BLOCKS, SHARE * structured.sum()))


def are_combed(images: Sequence[NDArray[np.uint8]]) -> bool:
    """Whether images (H, W, 3) of a clip are those of an interlaced video."""
    return sum(map(is_combed, images)) > LEAST_IMAGES * len(images)
