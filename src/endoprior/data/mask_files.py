"""Read a user's mask files in all usual formats, and decide which of their values marks tools."""

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
from .mask_values import COLOR, JPEG_ERROR, HighValues, Tally, high_values, name, names
from .numpy_files import read_only_array

MASK_SUFFIXES = (".png", ".jpg", ".jpeg", ".tif", ".tiff", ".bmp", ".webp", ".npy", ".npz")
LOSSY = (".jpg", ".jpeg", ".webp")
MOST_LABEL_COLORS = 256
"""A file with more colors is a photo, not a mask."""
LEAST_CERTAINTY = 0.5
"""If the detected polarity is less certain, high values mark tools by convention."""
LABELS = "--mask-labels"


def read_user_mask(path: Path, size: tuple[int, int], rule: HighValues | None = None) -> NDArray[np.bool_]:
    """Read a mask in any usual format.

    Images: 0 and 255, 0 and 1, smoothed or compressed gray (above half is high), label images (above 0 is high), colors
    on black (not black is high), an alpha channel that is not the same everywhere (more than half opaque is high).
    `.npy`, or `.npz` with one array: bool, also several masks in a stack (their union), labels, probabilities in
    [0, 1] (above 0.5 is high), logits (some below 0; above 0 is high).

    Args:
        path: the file.
        size: (width, height) of the frames, px.
        rule: which values of its folder are high, from `rule_of_files`; None decides by this file alone.
    Returns:
        (H, W) True where the value is high. `tool_polarity` tells whether high values mark tools.
    Raises:
        InputError: the file is unreadable, has another size or values that are not finite, or is not a mask.
    """
    rule = rule or rule_of_files([path])
    high = rule.of(_numbers(path))
    if high.shape != size[::-1]:
        got = f"{high.shape[1]}x{high.shape[0]}"
        hint = "Export masks at the size of the images."
        raise input_error(path, f"{size[0]}x{size[1]} px like the images", got, hint)
    return high


def rule_of_files(files: Sequence[Path], asked: str = "") -> HighValues:
    """Which values are high in the masks of a folder. All files are decoded.

    Args:
        files: of one clip; a label that occurs in a single frame counts.
        asked: labels that are high, separated by commas: numbers, or colors such as `#ff5500`; empty for all above 0.
    Raises:
        InputError: a file is no mask, or has no labels of these names.
    """
    tally, odd = Tally(), None
    for file in files:
        values = _numbers(file)
        tally.add(values, file.suffix.lower() in LOSSY)
        if values.dtype.kind == "f" and values.max(initial=0) > 1 and (values != np.round(values)).any():
            odd = odd or (file, values)
    if odd and tally.lowest >= 0:
        got = f"values up to {odd[1].max():g}"
        raise input_error(odd[0], "labels, probabilities in [0, 1] or logits", got, "Save a bool array.")
    rule = high_values(tally)
    return _chosen(tally, asked, files[0].parent) if asked else rule


def demand_known(folder: Path, rule: HighValues, fix: str) -> None:
    """Raise InputError if the values do not tell which labels are tools. Args: fix: what to do then."""
    if rule.doubt:
        raise input_error(folder, "masks of tools, or labels on a background of 0", rule.doubt, fix)


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


def _chosen(tally: Tally, asked: str, folder: Path) -> HighValues:
    """The labels that the user names; InputError if one does not occur or the files have no labels."""
    known = sorted(tally.pixels)
    if tally.lossy or tally.fractions:
        kind = "compressed with errors" if tally.lossy else "fractions"
        raise input_error(LABELS, f"labels in {folder}", f"values that are {kind}", f"Remove {LABELS}.")
    by_name = {name(number): number for number in known}
    wanted = []
    for text in (part.strip().lower() for part in asked.split(",")):
        plain = text if text.startswith("#") else text.lstrip("0") or "0"
        if plain not in by_name:
            fix = f"`{LABELS} {name(known[-1])}`."
            raise input_error(LABELS, f"labels of {folder} ({names(known)})", text or "nothing", fix)
        wanted.append(by_name[plain])
    return HighValues(0, chosen=tuple(wanted), labels=tuple(known))


def _numbers(path: Path) -> NDArray:
    """(H, W) bool or finite numbers of a file; a color is a number from `COLOR` on, and black is 0."""
    if path.suffix.lower() in (".npy", ".npz"):
        return _load_array(path)
    pixels = decode_image(path, None)
    return _of_colors(path, pixels) if pixels.ndim == 3 else _finite(path, pixels)


def _load_array(path: Path) -> NDArray:
    """(H, W) numbers; the union of a stack of bool masks."""
    hint = "Save one array of shape (height, width)."
    loaded = read_only_array(path, hint)
    values = np.squeeze(loaded)
    if values.dtype == bool and values.ndim == 3:
        values = values.any(0)
    if values.ndim != 2 or values.dtype.kind not in "buif":
        raise input_error(path, "numbers of shape (height, width)", f"{loaded.dtype} of {loaded.shape}", hint)
    return _finite(path, values)


def _finite(path: Path, values: NDArray) -> NDArray:
    wrong = int((~np.isfinite(values)).sum()) if values.dtype.kind == "f" else 0
    if wrong:
        raise input_error(path, "finite numbers", f"{wrong} NaN or infinite ones", "Replace them before saving.")
    return values


def _of_colors(path: Path, pixels: NDArray) -> NDArray:
    """(H, W) numbers of the colors (H, W, C) of an image."""
    if pixels.shape[2] == 4:
        alpha = pixels[..., 3]
        if (alpha != alpha[0, 0]).any() or not alpha.any():
            return alpha
    color = pixels[..., :3]
    lossy = path.suffix.lower() in LOSSY
    if int(np.ptp(color, axis=-1).max(initial=0)) <= (JPEG_ERROR if lossy else 0):
        return np.ascontiguousarray(color[..., 1])
    if lossy:
        return np.where(color.max(-1) > 2 * JPEG_ERROR, 255, 0).astype(np.uint8)
    numbers = color.astype(np.int64) @ np.array([1, 1 << 16, 1 << 32]) + COLOR  # blue first
    if len(np.unique(numbers)) > MOST_LABEL_COLORS:
        raise input_error(path, "a mask", "an image of many colors", "Pass masks, not photos or overlays.")
    is_gray = np.ptp(color, axis=-1) == 0
    return np.where(is_gray, color[..., 1].astype(np.int64), numbers)
