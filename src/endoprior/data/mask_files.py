"""Read a user's mask files in all usual formats, and decide which of their values are high, and which mark tools.

One decision for all files of a folder, from what occurs in them: two values, smoothed outlines and labels look alike in
a single file, where 0, 1 and 255 may be a tool with a rim to ignore.
"""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Literal, TypeVar

import cv2
import numpy as np
from numpy.typing import NDArray

from ..core.checks import check_shape, input_error
from ..footage.image_operations import Image, Mask
from .images import Size, decode_image
from .reading import read_only_array

JPEG_ERROR = 32  # largest compression error next to an outline, in levels 0..255
FLAT_ERROR = 2  # largest compression error inside of a region
MAX_LABELS = 32  # with more values, those near the lowest and the highest one are compression errors
MAX_AREA = 0.5  # labels that cover a larger share of the images may be tissue as well
MIN_LABEL_SHARE = 0.05  # values between that are a smaller share of such an area are errors, not labels
COLOR = 1 << 56
"""Colors are numbers from here on, with 16 bits for each of red, green and blue; black and grays are their level."""
MASK_SUFFIXES = (".png", ".jpg", ".jpeg", ".tif", ".tiff", ".bmp", ".webp", ".npy", ".npz")
LOSSY = (".jpg", ".jpeg", ".webp")
MAX_LABEL_COLORS = 256  # a file with more colors is a photo, not a mask
MIN_CERTAINTY = 0.5  # if the detected polarity is less certain, high values mark tools by convention
OPTION = "--mask-labels"
Label = TypeVar("Label")


@dataclass(frozen=True)
class HighValues:
    """Which values are high."""

    above: float  # larger values are ...
    chosen: tuple[int, ...] = ()  # ... unless the user has chosen these
    labels: tuple[int, ...] = ()  # the values that occur, unless they are two, smoothed, or fractions
    doubt: str = ""  # why it is not known which labels are tools; empty where it is

    def of(self, values: NDArray) -> Mask:
        """(H, W) True where numbers (H, W) are high."""
        return np.isin(values, self.chosen) if self.chosen else values > self.above

    @property
    def note(self) -> str:
        """What was made of labels, for the user; empty where there are none."""
        if self.chosen:
            return f"tools: labels {names(self.chosen)} of {names(self.labels)}"
        return f"labels {names(self.labels)}; tools: all above 0" if self.labels else ""


@dataclass
class Tally:
    """The values of the files of a folder."""

    pixels: dict[int, int] = field(default_factory=dict)  # how often each whole number occurs
    slopes: dict[int, int] = field(default_factory=dict)
    """How often a pixel of that number has both a smaller and a larger neighbor, as on a smoothed outline."""
    fractions: bool = False  # whether other numbers occur
    lowest: float = np.inf
    lossy: bool = False  # whether a file is compressed with errors

    def add(self, values: NDArray, lossy: bool) -> None:
        """Count the numbers (H, W) of a file, bool or finite."""
        self.lossy |= lossy
        if values.size:
            self.lowest = min(self.lowest, float(values.min()))
        if values.dtype.kind == "f":
            if (values != np.round(values)).any():
                self.fractions = True
                return
            values = values.astype(np.int64)
        on_slope = _on_slope(values, FLAT_ERROR if lossy else 0)
        for counts, counted in ((self.pixels, values), (self.slopes, values[on_slope])):
            for number, count in _counts(counted):
                counts[number] = counts.get(number, 0) + count


def high_values(tally: Tally) -> HighValues:
    """Which values are high: above half of two values or of fractions, above 0 of logits and of labels.

    Values between the lowest and the highest one are smoothed outlines if most of their pixels are on a slope. Else
    they are labels.
    """
    if tally.fractions:
        return HighValues(0.0 if tally.lowest < 0 else 0.5)
    numbers = sorted(tally.pixels)
    if len(numbers) < 2:
        return HighValues(JPEG_ERROR if tally.lossy else 0)
    lowest, highest = numbers[0], numbers[-1]
    colors = highest >= COLOR
    full = 255 if highest <= 255 else 65535
    # An image that was compressed before has values next to both ends.
    compressed = {lowest + 1, highest - 1} <= tally.pixels.keys() and highest == full
    uneven = not colors and (tally.lossy or compressed or len(numbers) > MAX_LABELS)
    margin = JPEG_ERROR * highest / full if uneven else 0
    between = [number for number in numbers if lowest + margin < number < highest - margin]
    count = sum(tally.pixels[number] for number in between)
    smooth = sum(tally.slopes.get(number, 0) for number in between) > count / 2
    # A few steps below the full range are labels, however thin.
    may_be_smooth = not colors and (uneven or highest >= 0.9 * full)
    half = (max(lowest, 0) + highest) / 2
    if not between or (smooth and may_be_smooth):
        known = 0 in tally.pixels or not colors  # of two colors, none is high
        two = HighValues(max(half, JPEG_ERROR) if tally.lossy else half)
        return two if known else HighValues(0, labels=tuple(numbers), doubt=f"the colors {names(numbers)}")
    area = sum(count for number, count in tally.pixels.items() if number > margin)
    share = area / sum(tally.pixels.values())
    if share > MAX_AREA and 0 in tally.pixels and count < MIN_LABEL_SHARE * area:
        return HighValues(half)
    doubt = f"the labels {names(numbers)}, those above 0 on {share:.0%} of the pixels"
    known = 0 in tally.pixels and share <= MAX_AREA
    labels = () if tally.lossy else tuple(numbers)
    return HighValues(JPEG_ERROR if tally.lossy else 0, labels=labels, doubt="" if known else doubt)


def name(number: int) -> str:
    """A label as the user types it: `3`, or `#ff5500` for a color."""
    if number < COLOR:
        return str(number)
    channels = [number >> shift & 0xFFFF for shift in (32, 16, 0)]
    digits = 2 if max(channels) < 256 else 4
    return "#" + "".join(f"{channel:0{digits}x}" for channel in channels)


def names(numbers: Iterable[int], most: int = 12) -> str:
    """Labels as text, at most so many of them."""
    listed = [name(number) for number in numbers]
    return ", ".join(listed[:most]) + (f" and {len(listed) - most} more" if len(listed) > most else "")


def asked_labels(subject: Path, asked: str, labels: Mapping[str, Label], known: str, example: str) -> list[Label]:
    """The labels that the user names, separated by commas, without regard to case and leading zeros: 001 is 1.

    `subject`, `known` and `example` are the place of the labels, all of them, and one of them, for messages.
    """

    def plain(text: str) -> str:
        return text.strip().casefold().lstrip("0") or "0"

    by_name = {plain(label): value for label, value in labels.items()}
    wanted = [text.strip() for text in asked.split(",") if text.strip()] or ["nothing"]
    for text in wanted:
        if plain(text) not in by_name:
            raise input_error(OPTION, f"labels of {subject} ({known})", text, f"`{OPTION} {example}`.")
    return [by_name[plain(text)] for text in wanted]


def _counts(values: NDArray) -> Iterable[tuple[int, int]]:
    if values.dtype.kind in "bu" and values.dtype.itemsize <= 2:
        counts = np.bincount(values.ravel())
        return [(int(number), int(counts[number])) for number in np.flatnonzero(counts)]
    return [(int(number), int(count)) for number, count in zip(*np.unique(values, return_counts=True), strict=True)]


def _on_slope(values: NDArray, error: int) -> Mask:
    """(H, W) True where one of the 8 neighbors is smaller and one larger, each by more than `error`."""
    if not values.size:
        return np.zeros(values.shape, bool)
    known = values.dtype in (np.uint8, np.uint16)
    numbers = values if known else values.astype(np.uint8 if values.dtype == bool else np.float64)
    low, high = (change(numbers, np.ones((3, 3), np.uint8)).astype(np.float64) for change in (cv2.erode, cv2.dilate))
    return (low + error < numbers) & (numbers + error < high)


def read_user_mask(path: Path, size: Size, rule: HighValues | None = None) -> Mask:
    """Read a mask in any usual format: (H, W) True where the value is high. `tool_polarity` tells if that is a tool.

    Images: 0 and 255, 0 and 1, smoothed or compressed gray (above half is high), label images (above 0 is high), colors
    on black (not black is high), an alpha channel that is not the same everywhere (more than half opaque is high).
    `.npy`, or `.npz` with one array: bool, also several masks in a stack (their union), labels, probabilities in
    [0, 1] (above 0.5 is high), logits (some below 0; above 0 is high).

    Args:
        size: (width, height) of the frames, px.
        rule: which values of its folder are high, from `rule_of_files`; None decides by this file alone.
    """
    rule = rule or rule_of_files([path])
    high = rule.of(_numbers(path))
    demand_size(path, (high.shape[1], high.shape[0]), size)
    return high


def demand_size(subject: Path | str, got: Size, size: Size) -> None:
    """Raise InputError unless a mask has the size of the frames."""
    if got != size:
        want = f"{size[0]}x{size[1]} px like the images"
        raise input_error(subject, want, f"{got[0]}x{got[1]}", "Export masks at the size of the images.")


def rule_of_files(files: Sequence[Path], asked: str = "") -> HighValues:
    """Which values are high in the masks of a clip. All are decoded: a label that occurs in a single frame counts.

    `asked` names labels that are high, separated by commas: numbers, or colors such as `#ff5500`; empty: all above 0.
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
    if not asked:
        return high_values(tally)
    folder, known = files[0].parent, sorted(tally.pixels)
    if tally.lossy or tally.fractions:
        kind = "compressed with errors" if tally.lossy else "fractions"
        raise input_error(OPTION, f"labels in {folder}", f"values that are {kind}", f"Remove {OPTION}.")
    chosen = asked_labels(folder, asked, {name(number): number for number in known}, names(known), name(known[-1]))
    return HighValues(0, chosen=tuple(chosen), labels=tuple(known))


def demand_known(folder: Path, rule: HighValues, fix: str) -> None:
    """Raise InputError if the values do not tell which labels are tools. Args: fix: what to do then."""
    if rule.doubt:
        raise input_error(folder, "masks of tools, or labels on a background of 0", rule.doubt, fix)


def _numbers(path: Path) -> NDArray:
    """(H, W) bool or finite numbers of a file; a color is a number from `COLOR` on, and black is 0."""
    hint = "Save one array of shape (height, width)."
    if path.suffix.lower() in (".npy", ".npz"):
        loaded = read_only_array(path, hint)
        values = np.squeeze(loaded)
        if values.dtype == bool and values.ndim == 3:
            values = values.any(0)
        if values.ndim != 2 or values.dtype.kind not in "buif":
            raise input_error(path, "numbers of shape (height, width)", f"{loaded.dtype} of {loaded.shape}", hint)
    else:
        values = decode_image(path, None)
        if values.ndim == 3:
            return _of_colors(path, values)
    if wrong := int((~np.isfinite(values)).sum()) if values.dtype.kind == "f" else 0:
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
    if len(np.unique(numbers)) > MAX_LABEL_COLORS:
        raise input_error(path, "a mask", "an image of many colors", "Pass masks, not photos or overlays.")
    is_gray = np.ptp(color, axis=-1) == 0
    return np.where(is_gray, color[..., 1].astype(np.int64), numbers)


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
    """Detect which value of the masks marks tools: of the two regions, the smaller and grayer one with less of the
    border. If one value does not occur, that one, with certainty 0.

    Args:
        highs: (H, W) True where the mask's value is high. images: (H, W, 3) their frames; a dozen are enough.
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


def tool_polarity(
    tool_value: Literal["auto", "high", "low"], highs: Sequence[Mask], images: Sequence[Image]
) -> Polarity:
    """Which value marks tools: the given one, else the detected one, else high values by convention.

    `highs` are of `read_user_mask`, `images` the frames of these masks; a dozen are enough. The `reason` is for users.
    """
    if tool_value != "auto":
        return Polarity(tool_value == "high", 1.0, f"{tool_value} values mark tools (--mask-tool-value)")
    detected = mask_polarity(highs, images)
    if detected.certainty < MIN_CERTAINTY:
        reason = f"detection unclear, high values mark tools by convention: {detected.reason}"
        return Polarity(True, detected.certainty, reason)
    value = "high" if detected.tool_is_high else "low"
    return replace(detected, reason=f"{value} values mark tools: {detected.reason}")
