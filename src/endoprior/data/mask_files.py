"""Read a user's mask files in all usual formats, and decide which of their two values marks tools."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path
from typing import Literal

import numpy as np
from numpy.typing import NDArray

from ..core.checks import input_error
from ..footage.polarity import Polarity, mask_polarity
from .images import decode_image
from .numpy_files import read_only_array

MASK_SUFFIXES = (".png", ".jpg", ".jpeg", ".tif", ".tiff", ".bmp", ".webp", ".npy", ".npz")
LOSSY = (".jpg", ".jpeg", ".webp")
JPEG_ERROR = 32
"""Largest compression error next to an outline, in levels 0..255."""
MOST_LABEL_COLORS = 256
"""A file with more colors is a photo, not a mask."""
LEAST_CERTAINTY = 0.5
"""If the detected polarity is less certain, high values mark tools by convention."""


def read_user_mask(path: Path, size: tuple[int, int]) -> NDArray[np.bool_]:
    """Read a mask in any usual format.

    Images: 0 and 255, 0 and 1, smoothed or compressed gray (above half is high), label images (above 0 is high), colors
    on black (not black is high), an alpha channel that is not the same everywhere (more than half opaque is high).
    `.npy`, or `.npz` with one array: bool, also several masks in a stack (their union), labels, probabilities in
    [0, 1] (above 0.5 is high), logits (some below 0; above 0 is high).

    Args:
        path: the file.
        size: (width, height) of the frames, px.
    Returns:
        (H, W) True where the value is high. `tool_polarity` tells whether high values mark tools.
    Raises:
        InputError: the file is unreadable, has another size or values that are not finite, or is not a mask.
    """
    values = _load_array(path) if path.suffix.lower() in (".npy", ".npz") else decode_image(path, None)
    high = _high_of_colors(path, values) if values.ndim == 3 else _high_of_numbers(path, values)
    if high.shape != size[::-1]:
        got = f"{high.shape[1]}x{high.shape[0]}"
        hint = "Export masks at the size of the images."
        raise input_error(path, f"{size[0]}x{size[1]} px like the images", got, hint)
    return high


def tool_polarity(
    tool_value: Literal["auto", "high", "low"],
    highs: Sequence[NDArray[np.bool_]],
    images: Sequence[NDArray[np.uint8]],
) -> Polarity:
    """Which value marks tools: the given one, else the detected one, else high values by convention.

    Args:
        tool_value: `high`, `low`, or `auto` to detect it.
        highs: (H, W) each, from `read_user_mask`.
        images: (H, W, 3) each, 0..255, the frames of these masks; a dozen are enough.
    Returns:
        The polarity; its `reason` is a line to show to the user.
    Raises:
        ValueError: as `footage.polarity.mask_polarity`.
    """
    if tool_value != "auto":
        return Polarity(tool_value == "high", 1.0, f"{tool_value} values mark tools (--mask-tool-value)")
    detected = mask_polarity(highs, images)
    if detected.certainty < LEAST_CERTAINTY:
        reason = f"detection unclear, high values mark tools by convention: {detected.reason}"
        return Polarity(True, detected.certainty, reason)
    value = "high" if detected.tool_is_high else "low"
    return replace(detected, reason=f"{value} values mark tools: {detected.reason}")


def _load_array(path: Path) -> NDArray:
    """(H, W) numbers; the union of a stack of bool masks."""
    hint = "Save one array of shape (height, width)."
    loaded = read_only_array(path, hint)
    values = np.squeeze(loaded)
    if values.dtype == bool and values.ndim == 3:
        values = values.any(0)
    if values.ndim != 2 or values.dtype.kind not in "buif":
        raise input_error(path, "numbers of shape (height, width)", f"{loaded.dtype} of {loaded.shape}", hint)
    return values


def _high_of_colors(path: Path, pixels: NDArray) -> NDArray[np.bool_]:
    """(H, W) from (H, W, C) colors of an image."""
    if pixels.shape[2] == 4 and (pixels[..., 3] != pixels[0, 0, 3]).any():
        return pixels[..., 3] > np.iinfo(pixels.dtype).max / 2
    color = pixels[..., :3]
    lossy = path.suffix.lower() in LOSSY
    if int(np.ptp(color, axis=-1).max()) <= (JPEG_ERROR if lossy else 0):
        return _high_of_numbers(path, color[..., 1])
    if not lossy:
        packed = color.astype(np.uint64) @ np.array([1, 1 << 16, 1 << 32], np.uint64)
        if len(np.unique(packed)) > MOST_LABEL_COLORS:
            raise input_error(path, "a mask", "an image of many colors", "Pass masks, not photos or overlays.")
    return color.max(-1) > (2 * JPEG_ERROR if lossy else 0)


def _high_of_numbers(path: Path, values: NDArray) -> NDArray[np.bool_]:
    """(H, W) from (H, W) numbers."""
    if values.dtype == bool:
        return values
    if values.dtype.kind == "f":
        wrong = int((~np.isfinite(values)).sum())
        if wrong:
            raise input_error(path, "finite numbers", f"{wrong} NaN or infinite ones", "Replace them before saving.")
        whole = bool((values == np.round(values)).all())
        if values.min(initial=0) < 0:
            return values > 0
        if values.max(initial=0) <= 1:
            return values > 0.5
        if not whole:
            got = f"values up to {values.max():g}"
            raise input_error(path, "labels, probabilities in [0, 1] or logits", got, "Save a bool array.")
    highest = float(values.max(initial=0))
    full = 255 if highest <= 255 else 65535
    if path.suffix.lower() in LOSSY:  # which cannot hold labels
        return values > max(highest / 2, JPEG_ERROR)
    # A maximum near full range: two values, possibly smoothed. A lower maximum: labels.
    if highest >= 0.9 * full:
        return values > highest / 2
    return values > 0
