"""The unit of stored depth maps, guessed by the usual distance of an endoscope.

A laparoscope is 20 to 250 mm away from tissue and carries its own light: near tissue is bright, and instruments are
nearer than the tissue around them. If larger values are nearer, the values are disparity or inverse depth.
"""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass
from typing import Literal

import cv2
import numpy as np
from numpy.typing import NDArray

from .image_operations import Image, Mask

Unit = Literal["mm", "m", "cm", "0.1 mm", "0.01 mm", "ambiguous", "disparity", "none"]
NEAR_MM, FAR_MM = 20.0, 250.0  # Usual distances from an endoscope to tissue
RANGES: tuple[tuple[Unit, float, float, float], ...] = (
    ("mm", NEAR_MM, FAR_MM, 1.0),
    ("m", NEAR_MM / 1000, FAR_MM / 1000, 1000.0),
    ("cm", NEAR_MM / 10, NEAR_MM, 10.0),
    ("0.1 mm", FAR_MM, FAR_MM * 10, 0.1),
    ("0.01 mm", FAR_MM * 10, FAR_MM * 100, 0.01),
)
"""Unit, range of the median, mm per unit. Where two units are possible, the range belongs to the more common one."""
SHADING_LIMIT = 0.3  # Rank correlation of brightness and value above which larger means nearer
TOOL_LIMIT = 1.1  # Ratio of the value on a tool to that of the tissue around it above which larger means nearer
SAMPLES = 4000  # Number of pixels per image for the correlation
MIN_PIXELS = 50  # With fewer pixels no statistic is computed


@dataclass(frozen=True)
class UnitGuess:
    """The guessed unit of depth values, and the reason."""

    unit: Unit  # `ambiguous`: no unit gives a plausible distance; `none`: there is no depth
    mm_per_unit: float | None  # Factor to mm; None if the unit is unknown or not a length
    median: float  # Median of the values, in their own unit; 0 without any
    shading: float
    """Mean rank correlation of brightness and value on tissue, -1..1: about -0.6 for depth; 0 if unknown."""
    tool_ratio: float
    """Median value on tools divided by that of the tissue around them: about 0.6 for depth; NaN if unknown."""
    reason: str  # The measurements in one line


def guess_unit(frames: Iterable[tuple[NDArray[np.floating], Mask, Image, Mask]]) -> UnitGuess:
    """Guess the unit of depth from a few frames: values (H, W), their validity, image (H, W, 3), tissue mask."""
    medians, shadings, ratios = [], [], []
    for values, valid, image, tissue in frames:
        on_tissue = valid & tissue if (valid & tissue).any() else valid
        if not on_tissue.any():
            continue
        medians.append(float(np.median(values[on_tissue])))
        shadings.append(_shading(values, image, on_tissue))
        ratios.append(_tool_ratio(values, valid, tissue))
    if not medians:
        return UnitGuess("none", None, 0.0, 0.0, float("nan"), "no pixel has depth")
    shadings, ratios = ([value for value in found if value is not None] for found in (shadings, ratios))
    median = float(np.median(medians))
    shading = float(np.mean(shadings)) if shadings else 0.0
    tool = float(np.median(ratios)) if ratios else float("nan")
    if shading > SHADING_LIMIT:  # clear, unless tools contradict it; if shading is weak, tools decide
        larger_is_nearer = not tool < 1 / TOOL_LIMIT
    else:
        larger_is_nearer = shading > -SHADING_LIMIT / 2 and tool > TOOL_LIMIT
    if larger_is_nearer:
        tools = "" if np.isnan(tool) else f", tools have {tool:.2f} times the values around them"
        reason = f"larger values are nearer: brightness and value correlate by {shading:+.2f}{tools}"
        return UnitGuess("disparity", None, median, shading, tool, reason)
    for unit, low, high, factor in RANGES:
        if low <= median < high:
            reason = f"the median is {median:.4g}, which in {unit} is {median * factor:.0f} mm away"
            return UnitGuess(unit, factor, median, shading, tool, reason)
    reason = f"the median is {median:.4g}, which no usual unit brings to {NEAR_MM:.0f}-{FAR_MM:.0f} mm"
    return UnitGuess("ambiguous", None, median, shading, tool, reason)


def _shading(values: NDArray, image: Image, where: Mask) -> float | None:
    """Rank correlation of smoothed brightness and value; None for too few pixels or a constant value."""
    brightness = cv2.GaussianBlur(image.max(-1).astype(np.float32), (0, 0), max(image.shape[1] / 80, 1.0))
    picked = np.flatnonzero(where)
    picked = picked[:: max(1, len(picked) // SAMPLES)]
    a, b = brightness.reshape(-1)[picked], values.reshape(-1)[picked]
    if len(picked) < MIN_PIXELS or a.min() == a.max() or b.min() == b.max():
        return None
    return float(np.corrcoef(_ranks(a), _ranks(b))[0, 1])


def _ranks(values: NDArray) -> NDArray[np.float64]:
    """(N,) the rank of each of N values, from 1; equal ones share their mean rank. scipy.stats imports for 0.4 s."""
    _, place, count = np.unique(values, return_inverse=True, return_counts=True)
    return (np.cumsum(count) - (count - 1) / 2)[place]


def _tool_ratio(values: NDArray, valid: Mask, tissue: Mask) -> float | None:
    """Median on tools divided by the median of the tissue around them; None if either has too few pixels."""
    reach = max(3, values.shape[1] // 40)
    near_tool = cv2.dilate((~tissue).astype(np.uint8), np.ones((reach, reach), np.uint8)).astype(bool)
    on_tool, around = values[valid & ~tissue], values[valid & tissue & near_tool]
    if min(len(on_tool), len(around)) < MIN_PIXELS:
        return None
    return float(np.median(on_tool) / max(float(np.median(around)), 1e-12))
