"""Measures over time for people and spreadsheets: a CSV table, and the color scales of the surface maps."""

from __future__ import annotations

import csv
import io
import math
from collections.abc import Iterable

import numpy as np
from numpy.typing import NDArray

from ..model.measures import Measures
from .image_tools import colorize

UNKNOWN_GRAY = 128
LEAST_DISPLACEMENT, LEAST_STRETCH = 1e-3, 0.05
"""The color scales reach at least this far, so that rounding is not colored."""


def displacement_span(values: NDArray) -> tuple[float, float]:
    """Ends of the color scale: 0 to the 98th percentile of what is known."""
    known = values[np.isfinite(values)]
    return 0.0, max(float(np.percentile(known, 98)) if len(known) else 0.0, LEAST_DISPLACEMENT)


def stretch_span(values: NDArray) -> tuple[float, float]:
    """Ends of the color scale, as far below 1 as above it: unchanged tissue is in the middle."""
    known = np.abs(values[np.isfinite(values)] - 1)
    reach = max(float(np.percentile(known, 98)) if len(known) else 0.0, LEAST_STRETCH)
    return 1 - reach, 1 + reach


def value_colors(values: NDArray, span: tuple[float, float]) -> NDArray[np.uint8]:
    """(N, 3) turbo colors of (N,) values; gray where unknown."""
    colors = colorize(values[None], *span)[0]
    return np.where(np.isfinite(values)[:, None], colors, np.uint8(UNKNOWN_GRAY))


def measures_csv(found: Measures, frames_per_second: float, unit: str, confidence: NDArray | None = None) -> str:
    """The table of `found`: one row for each frame; empty where unknown.

    Args:
        unit: of lengths, for the names of the columns.
        confidence: (T, P) of the tracks; adds a column for each point.
    """
    total, num_points = found.displacement.shape
    columns: dict[str, Iterable] = {
        "frame": range(total),
        "time": [f"{i / total:.6f}" for i in range(total)],
        "seconds": [f"{i / frames_per_second:.4f}" for i in range(total)],
    }
    name = unit.rstrip(".")
    if num_points > 1:
        columns[f"distance_{name}"] = _texts(found.distance)
    if num_points > 2:
        columns[f"area_{name}2"] = _texts(found.area)
    for p in range(num_points):
        columns[f"path_{p}_{name}"] = _texts(found.path_length[:, p])
        columns[f"path_raw_{p}_{name}"] = _texts(found.path_length_raw[:, p])
        columns[f"displacement_{p}_{name}"] = _texts(found.displacement[:, p])
        columns[f"stretch_{p}"] = _texts(found.stretch[:, p])
        if confidence is not None:
            columns[f"confidence_{p}"] = _texts(confidence[:, p])
    text = io.StringIO()
    table = csv.writer(text, lineterminator="\n")
    table.writerow(columns)
    table.writerows(zip(*columns.values(), strict=True))
    return text.getvalue()


def _texts(values: NDArray) -> list[str]:
    return [f"{value:.4f}" if math.isfinite(value) else "" for value in values]
