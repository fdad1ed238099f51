"""Which stored values of a folder of masks are high. One decision for all of its files, from what occurs in them.

Two values, smoothed outlines and labels look alike in a single file: 0, 1 and 255 may be a tool with a rim to ignore.
"""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass, field

import cv2
import numpy as np
from numpy.typing import NDArray

JPEG_ERROR = 32
"""Largest compression error next to an outline, in levels 0..255."""
FLAT_ERROR = 2
"""Largest compression error inside of a region."""
MOST_LABELS = 32
"""With more values, those near the lowest and the highest one are compression errors."""
MOST_AREA = 0.5
"""Labels that cover a larger share of the images may be tissue as well."""
LEAST_SHARE = 0.05
"""Values between that are a smaller share of such an area are errors, not labels."""
COLOR = 1 << 56
"""Colors are numbers from here on, with 16 bits for each of red, green and blue; black and grays are their level."""


@dataclass(frozen=True)
class HighValues:
    """Which values are high."""

    above: float
    """Larger values are ..."""
    chosen: tuple[int, ...] = ()
    """... unless the user has chosen these."""
    labels: tuple[int, ...] = ()
    """The values that occur, where they are labels; empty where they are two, smoothed, or fractions."""
    doubt: str = ""
    """Why it is not known which labels are tools; empty where it is."""

    def of(self, values: NDArray) -> NDArray[np.bool_]:
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

    pixels: dict[int, int] = field(default_factory=dict)
    """How often each whole number occurs."""
    slopes: dict[int, int] = field(default_factory=dict)
    """How often a pixel of that number has both a smaller and a larger neighbor, as on a smoothed outline."""
    fractions: bool = False
    """Whether other numbers occur."""
    lowest: float = np.inf
    highest: float = -np.inf
    lossy: bool = False
    """Whether a file is compressed with errors."""

    def add(self, values: NDArray, lossy: bool) -> None:
        """Count the numbers (H, W) of a file, bool or finite."""
        self.lossy |= lossy
        if values.size:
            self.lowest, self.highest = min(self.lowest, values.min()), max(self.highest, values.max())
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
    uneven = not colors and (tally.lossy or compressed or len(numbers) > MOST_LABELS)
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
    if share > MOST_AREA and 0 in tally.pixels and count < LEAST_SHARE * area:
        return HighValues(half)
    doubt = f"the labels {names(numbers)}, those above 0 on {share:.0%} of the pixels"
    known = 0 in tally.pixels and share <= MOST_AREA
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


def _counts(values: NDArray) -> Iterable[tuple[int, int]]:
    if values.dtype.kind in "bu" and values.dtype.itemsize <= 2:
        counts = np.bincount(values.ravel())
        return [(int(number), int(counts[number])) for number in np.flatnonzero(counts)]
    return [(int(number), int(count)) for number, count in zip(*np.unique(values, return_counts=True), strict=True)]


def _on_slope(values: NDArray, error: int) -> NDArray[np.bool_]:
    """(H, W) True where one of the 8 neighbors is smaller and one larger, each by more than `error`."""
    if not values.size:
        return np.zeros(values.shape, bool)
    known = values.dtype in (np.uint8, np.uint16)
    numbers = values if known else values.astype(np.uint8 if values.dtype == bool else np.float64)
    low, high = (change(numbers, np.ones((3, 3), np.uint8)).astype(np.float64) for change in (cv2.erode, cv2.dilate))
    return (low + error < numbers) & (numbers + error < high)
