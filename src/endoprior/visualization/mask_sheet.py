"""A sheet of frames with their tool masks, to check many masks at one look."""

from __future__ import annotations

from collections.abc import Sequence

import cv2
import numpy as np
from numpy.typing import NDArray

from .image_tools import label, tile

COLOR = (0, 200, 255)
"""RGB of masks: cyan, which tissue never has."""


def mask_sheet(
    frames: Sequence[tuple[NDArray[np.uint8], NDArray[np.bool_], str]], columns: int, width_px: int
) -> NDArray[np.uint8]:
    """Frames with their masks tinted and outlined.

    Args:
        frames: image (H, W, 3), mask (H, W), text in its corner.
        width_px: of a frame on the sheet.
    Returns:
        (rows * h, columns * width_px, 3).
    """
    tiles = []
    for rgb_u8, mask, text in frames:
        size = (width_px, round(rgb_u8.shape[0] * width_px / rgb_u8.shape[1]))
        image = cv2.resize(rgb_u8, size, interpolation=cv2.INTER_AREA)
        tool = cv2.resize(mask.astype(np.uint8), size, interpolation=cv2.INTER_NEAREST)
        image[tool > 0] = (0.6 * image[tool > 0] + 0.4 * np.array(COLOR)).astype(np.uint8)
        outlines, _ = cv2.findContours(tool, cv2.RETR_EXTERNAL, cv2.CHAIN_APPROX_NONE)
        tiles.append(label(cv2.drawContours(image, outlines, -1, COLOR, 1), text))
    return tile(tiles, columns)
