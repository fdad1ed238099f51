"""What a processor puts around and over the image: a black border, and the moving box of a detection with its text."""

from __future__ import annotations

import cv2
import numpy as np
from numpy.typing import NDArray

from .config import PhantomConfig

Mask = NDArray[np.bool_]
RED = (250, 10, 20)
CUT = 0.2  # Length of the cut corners, as a share of the height


def border(cfg: PhantomConfig) -> Mask:
    """(H, W) True outside of the image."""
    width, height = cfg.width, cfg.height
    seen, cut = np.zeros((height, width), np.uint8), round(CUT * height)
    right, down = width - 1, height - 1
    if cfg.border == "octagon":
        half = [(cut, 0), (right - cut, 0), (right, cut), (right, down - cut)]
        corners = [*half, *((right - x, down - y) for x, y in half)]
        cv2.fillPoly(seen, [np.array(corners, np.int32)], 1)
    elif cfg.border == "oval":
        cv2.ellipse(seen, (width // 2, height // 2), (round(0.46 * width), round(0.47 * height)), 0, 0, 360, 1, -1)
    elif cfg.border == "rounded":
        seen[cut:-cut, cut:-cut] = 1
        seen = np.asarray(cv2.dilate(seen, cv2.getStructuringElement(cv2.MORPH_ELLIPSE, (2 * cut + 1,) * 2)), np.uint8)
    else:
        seen[:] = 1
    return seen == 0


def overlay(cfg: PhantomConfig, index: int) -> Mask:
    """(H, W) True on the box and text of a frame; every fourth frame has none."""
    drawn, (width, height) = np.zeros((cfg.height, cfg.width), np.uint8), (cfg.width, cfg.height)
    if not cfg.overlay or index % 4 == 3:
        return drawn > 0
    x = round(width * (0.25 + 0.2 * np.sin(index / 7)))
    y = round(height * (0.3 + 0.2 * np.cos(index / 5)))
    thick = max(1, round(height / 200))
    cv2.rectangle(drawn, (x, y), (x + round(0.3 * width), y + round(0.3 * height)), 1, thick)
    cv2.putText(drawn, f"0.{(37 * index) % 100:02d}", (x, y - 4), cv2.FONT_HERSHEY_SIMPLEX, height / 350, 1, thick)
    return drawn > 0


def surrounded(image: NDArray[np.uint8], outside: Mask, drawn: Mask) -> NDArray[np.uint8]:
    """The image (H, W, 3) with a black outside, and the drawing over it."""
    image = np.where(outside[..., None], np.uint8(0), image)
    return np.where(drawn[..., None], np.array(RED, np.uint8), image)
