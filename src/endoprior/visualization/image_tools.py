"""Helpers for images and figures: color maps, labels, tiling, sheets of frames with their masks, PNG files."""

from __future__ import annotations

from collections.abc import Iterable
from pathlib import Path
from typing import TYPE_CHECKING

import cv2
import numpy as np
from numpy.typing import NDArray

from ..core.types import to_uint8
from ..data.images import save_png
from ..system.atomic import whole_file

if TYPE_CHECKING:
    from matplotlib.figure import Figure

SOLID_ALPHA = 0.5
"""There is no surface where alpha is lower."""
MASK_COLOR = (0, 200, 255)
"""RGB of masks: cyan, which tissue never has."""


def write_png(path: Path, rgb_u8: NDArray[np.uint8]) -> None:
    """Write an (H, W, 3) RGB or (H, W) gray 8-bit image, atomically."""
    with whole_file(path) as temporary:
        save_png(temporary, rgb_u8)


def save_figure(figure: Figure, path: Path) -> None:
    """Write a figure with a layout engine as a PNG file, completely or not at all.

    Matplotlib draws such a figure twice to save it, first only for its layout, which needs no drawing.
    """
    if (layout := figure.get_layout_engine()) is not None:
        layout.execute(figure)
        figure.set_layout_engine("none")
    with whole_file(path) as temporary:
        figure.savefig(temporary, format="png", pil_kwargs={"compress_level": 1})


def gray(unit: NDArray) -> NDArray[np.uint8]:
    """(H, W, 3) gray image of (H, W) values in [0, 1]."""
    return np.repeat(to_uint8(unit)[..., None], 3, -1)


def colorize(values: NDArray, low: float, high: float, valid: NDArray | None = None) -> NDArray[np.uint8]:
    """Turbo color map of (H, W) values: blue at `low`, red at `high`; black where `valid` is False."""
    unit = to_uint8((np.nan_to_num(values) - low) / max(high - low, 1e-9))
    colors: NDArray = cv2.applyColorMap(unit, cv2.COLORMAP_TURBO)[..., ::-1]
    return colors if valid is None else colors * np.asarray(valid, np.uint8)[..., None]


def scaled(image: NDArray, width_px: int) -> NDArray:
    """An image of that width: colors averaged, a mask (H, W) of 8 bits by the nearest pixel."""
    size = width_px, max(round(image.shape[0] * width_px / image.shape[1]), 1)
    return cv2.resize(image, size, interpolation=cv2.INTER_AREA if image.ndim == 3 else cv2.INTER_NEAREST)


def label(rgb_u8: NDArray[np.uint8], text: str) -> NDArray[np.uint8]:
    """A copy with `text` in the lower left corner, white with a black outline."""
    scale = max(rgb_u8.shape[1] / 900, 0.35)
    at = (int(8 * scale) + 2, rgb_u8.shape[0] - int(10 * scale) - 2)
    letters = np.zeros(rgb_u8.shape[:2], np.uint8)  # how much of a pixel they cover
    cv2.putText(letters, text, at, cv2.FONT_HERSHEY_SIMPLEX, scale, 255, 1, cv2.LINE_AA)
    side = 2 * max(1, round(scale)) + 1
    outlined = cv2.dilate(letters, np.ones((side, side), np.uint8))  # in OpenCV 5 thick letters are wider
    shares = np.stack([255 - outlined, letters], -1).astype(np.uint16)
    return ((rgb_u8 * shares[..., :1] + 255 * shares[..., 1:] + 127) // 255).astype(np.uint8)


def tile(images: list[NDArray[np.uint8]], columns: int) -> NDArray[np.uint8]:
    """Images of one size, tiled row by row in `columns`; missing ones are black."""
    padded = images + [np.zeros_like(images[0])] * (-len(images) % columns)
    return np.concatenate([np.concatenate(padded[i : i + columns], 1) for i in range(0, len(padded), columns)])


def mask_sheet(
    frames: Iterable[tuple[NDArray[np.uint8], NDArray[np.bool_], str]], columns: int, width_px: int
) -> NDArray[np.uint8]:
    """Frames with their masks tinted and outlined, in rows of `columns`.

    Args:
        frames: image (H, W, 3), mask (H, W), text in its corner.
        width_px: of a frame on the sheet.
    """
    tiles = []
    for rgb_u8, mask, text in frames:
        image, tool = scaled(rgb_u8, width_px), scaled(mask.astype(np.uint8), width_px)
        image[tool > 0] = (0.6 * image[tool > 0] + 0.4 * np.array(MASK_COLOR)).astype(np.uint8)
        outlines, _ = cv2.findContours(tool, cv2.RETR_EXTERNAL, cv2.CHAIN_APPROX_NONE)
        cv2.drawContours(image, outlines, -1, MASK_COLOR, 1)
        tiles.append(label(image, text))
    return tile(tiles, columns)
