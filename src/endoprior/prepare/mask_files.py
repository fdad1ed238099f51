"""A user's own masks: files of the usual forms, and which of their two values marks tools."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import Literal

import numpy as np
from numpy.typing import NDArray

from ..data.images import decode_image
from ..data.numpy_files import read_only_array
from ..data.reading import complaint
from ..footage.polarity import Polarity, mask_polarity

SUFFIXES = (".png", ".jpg", ".jpeg", ".tif", ".tiff", ".bmp", ".webp", ".npy", ".npz")
LOSSY = (".jpg", ".jpeg", ".webp")
JPEG_ERROR = 32
"""Levels by which compression may move a value, 0..255, beside an outline."""
MOST_LABEL_COLORS = 256
"""An image of more colors is a picture, not a mask."""
LEAST_CERTAINTY = 0.5
"""Of a detected polarity; below, the convention holds: high values mark tools."""


def read_user_mask(path: Path, size: tuple[int, int]) -> NDArray[np.bool_]:
    """Read a mask of any usual form.

    Images: 0 and 255, 0 and 1, smoothed or compressed gray (above half is high), label images (above 0 is high), colors
    on black (not black is high), an alpha channel that is not the same everywhere (more than half opaque is high).
    `.npy`, or `.npz` with one array: bool, also several masks in a stack (their union), labels, probabilities in
    [0, 1] (above 0.5 is high), logits (some below 0; above 0 is high).

    Args:
        path: the file.
        size: (width, height) of the frames, px.
    Returns:
        (H, W) True where the value is high; whether that means tool is a matter of polarity.
    Raises:
        InputError: unreadable, of another size, not finite, or no mask.
    """
    values = _load_array(path) if path.suffix.lower() in (".npy", ".npz") else decode_image(path, None)
    high = _high_of_colors(path, values) if values.ndim == 3 else _high_of_numbers(path, values)
    if high.shape != size[::-1]:
        got = f"{high.shape[1]}x{high.shape[0]}"
        hint = "Export masks at the size of the pictures."
        raise complaint(path, f"{size[0]}x{size[1]} px like the pictures", got, hint)
    return high


def tool_polarity(
    tool_value: Literal["auto", "high", "low"],
    highs: Sequence[NDArray[np.bool_]],
    pictures: Sequence[NDArray[np.uint8]],
) -> Polarity:
    """Which value marks tools: as told, else as detected, else by the convention that high values do.

    Args:
        tool_value: `high`, `low`, or `auto` to detect it.
        highs: (H, W) each, from `read_user_mask`.
        pictures: (H, W, 3) each, 0..255, the frames of these masks; a dozen are enough.
    Returns:
        The `reason` says in one line how it was decided; the caller shows it.
    Raises:
        ValueError: as `footage.polarity.mask_polarity`.
    """
    if tool_value != "auto":
        return Polarity(tool_value == "high", 1.0, f"{tool_value} values mark tools, as told")
    seen = mask_polarity(highs, pictures)
    if seen.certainty < LEAST_CERTAINTY:
        return Polarity(True, seen.certainty, f"high values are taken for tools by convention, unclear: {seen.reason}")
    return Polarity(
        seen.tool_is_high, seen.certainty, f"{'high' if seen.tool_is_high else 'low'} values mark tools: {seen.reason}"
    )


def _load_array(path: Path) -> NDArray:
    """(H, W) numbers; a stack of bool masks becomes their union."""
    hint = "Save one array of shape (height, width)."
    loaded = read_only_array(path, hint)
    if loaded.dtype == bool and loaded.ndim == 3 and 1 not in loaded.shape:
        loaded = loaded.any(0)
    values = np.squeeze(loaded)
    if values.ndim != 2 or values.dtype.kind not in "buif":
        raise complaint(path, "numbers of shape (height, width)", f"{loaded.dtype} of {loaded.shape}", hint)
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
            raise complaint(path, "a mask", "a picture of many colors", "Pass masks, not pictures or overlays.")
    return color.max(-1) > (2 * JPEG_ERROR if lossy else 0)


def _high_of_numbers(path: Path, values: NDArray) -> NDArray[np.bool_]:
    """(H, W) from (H, W) numbers."""
    if values.dtype == bool:
        return values
    if values.dtype.kind == "f":
        wrong = int((~np.isfinite(values)).sum())
        if wrong:
            raise complaint(path, "finite numbers", f"{wrong} NaN or infinite ones", "Replace them before saving.")
        whole = bool((values == np.round(values)).all())
        if values.min(initial=0) < 0:
            return values > 0
        if values.max(initial=0) <= 1:
            return values > 0.5
        if not whole:
            got = f"values up to {values.max():g}"
            raise complaint(path, "labels, probabilities in [0, 1] or logits", got, "Save a bool array.")
    highest = float(values.max(initial=0))
    full = 255 if highest <= 255 else 65535
    if path.suffix.lower() in LOSSY:  # which cannot hold labels
        return values > max(highest / 2, JPEG_ERROR)
    # Up to (nearly) full range: two values, perhaps smoothed. Below: labels.
    if highest >= 0.9 * full:
        return values > highest / 2
    return values > 0
