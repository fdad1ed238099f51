"""Measures over time for people and spreadsheets: a CSV table, maps of the surface, curves. T frames, P points."""

from __future__ import annotations

import csv
import io
import math
from collections.abc import Iterable, Mapping
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

from ..model.measures import Measures
from ..system.atomic import whole_file
from .image_tools import colorize

if TYPE_CHECKING:
    from matplotlib.axes import Axes

UNKNOWN_GRAY = 128
MIN_DISPLACEMENT, MIN_STRETCH = 1e-3, 0.05
"""The color scales reach at least this far, so that rounding is not colored."""


def displacement_span(values: NDArray) -> tuple[float, float]:
    """Ends of the color scale: 0 to the 98th percentile of what is known."""
    return 0.0, _reach(values, MIN_DISPLACEMENT)


def stretch_span(values: NDArray) -> tuple[float, float]:
    """Ends of the color scale, as far below 1 as above it: unchanged tissue is in the middle."""
    reach = _reach(np.abs(values - 1), MIN_STRETCH)
    return 1 - reach, 1 + reach


def _reach(values: NDArray, least: float) -> float:
    known = values[np.isfinite(values)]
    return max(float(np.percentile(known, 98)) if len(known) else 0.0, least)


def value_colors(values: NDArray, span: tuple[float, float]) -> NDArray[np.uint8]:
    """(N, 3) turbo colors of (N,) values; gray where unknown."""
    return np.where(np.isfinite(values)[:, None], colorize(values[None], *span)[0], np.uint8(UNKNOWN_GRAY))


def measures_csv(found: Measures, frames_per_second: float, unit: str, confidence: NDArray | None = None) -> str:
    """The table of `found`: one row for each frame; empty where unknown.

    Args:
        unit: of lengths, for the names of the columns.
        confidence: (T, P) of the tracks; adds a column for each point.
    """
    total, num_points = found.displacement.shape
    ranges = found.ranges
    columns: dict[str, Iterable] = {
        "frame": range(total),
        "time": [f"{i / total:.6f}" for i in range(total)],
        "seconds": [f"{i / frames_per_second:.4f}" for i in range(total)],
    }
    name = unit.rstrip(".")
    if num_points > 1:
        columns[f"distance_{name}"] = _texts(found.distance)
        if ranges:
            columns[f"distance_range95_{name}"] = _texts(ranges.distance)
    if num_points > 2:
        columns[f"area_{name}2"] = _texts(found.area)
        if ranges:
            columns[f"area_range95_{name}2"] = _texts(ranges.area)
    of_points = {
        f"path_{{}}_{name}": found.path_length,
        f"path_raw_{{}}_{name}": found.path_length_raw,
        f"displacement_{{}}_{name}": found.displacement,
        **({f"displacement_range95_{{}}_{name}": ranges.displacement} if ranges else {}),
        "stretch_{}": found.stretch,
    } | ({} if confidence is None else {"confidence_{}": confidence})
    for p in range(num_points):
        columns |= {column.format(p): _texts(values[:, p]) for column, values in of_points.items()}
    text = io.StringIO()
    table = csv.writer(text, lineterminator="\n")
    table.writerow(columns)
    table.writerows(zip(*columns.values(), strict=True))
    return text.getvalue()


def _texts(values: NDArray) -> list[str]:
    return [f"{value:.4f}" if math.isfinite(value) else "" for value in values]


def write_figure(
    path: Path,
    title: str,
    image: NDArray,
    points: NDArray,
    surface: tuple[NDArray, NDArray],
    maps: Mapping[str, tuple[NDArray, tuple[float, float]]],
    curves: tuple[Measures, float, str] | None,
) -> None:
    """Write a PNG file, completely or not at all: surface maps on top, curves over time below them.

    Args:
        image: (H, W, 3), which shows the points (P, 2), px, numbered as in the table.
        surface: (V, 2) pixels of a mesh's vertices, and (F, 3) their numbers in triangles.
        maps: by title, two maps of values (V,) with the ends of their color scale.
        curves: measures, frames per second and unit of lengths; None for no curves.
    """
    from matplotlib.backends.backend_agg import FigureCanvasAgg  # which takes long to import
    from matplotlib.figure import Figure

    # An own canvas: `pyplot` would choose a backend for the whole process.
    figure = Figure(figsize=(13, 10 if curves else 4.2), layout="constrained", dpi=100)
    FigureCanvasAgg(figure)
    figure.suptitle(title, fontsize=11, parse_math=False)
    rows = 2 if curves else 1
    parts = figure.subfigures(rows, 1, squeeze=False, height_ratios=[4, 6][:rows])[:, 0]
    first, *others = parts[0].subplots(1, 3)
    for axis in (first, *others):
        axis.set_axis_off()
    if curves:
        _show_curves(parts[1].subplots(2, 3).ravel(), *curves)
    height, width = image.shape[:2]
    first.imshow(image, extent=(0, width, height, 0))
    first.set_title("points", fontsize=9)
    if len(points) > 1:
        first.plot(*np.concatenate([points, points[:1]]).T, color="yellow", linewidth=0.8)
    for p, (x, y) in enumerate(points):
        first.plot(x, y, "o", color=f"C{p}", markeredgecolor="white", markersize=6)
        first.annotate(str(p), (x, y), (5, 4), textcoords="offset points", color="white", fontsize=9)
    first.set(xlim=(0, width), ylim=(height, 0))
    (pixels, triangles), limits = surface, {"xlim": first.get_xlim(), "ylim": first.get_ylim()}
    for axis, (name, (values, (low, high))) in zip(others, maps.items(), strict=True):
        faces = np.ma.masked_invalid(values[triangles].mean(1))
        shown = axis.tripcolor(*pixels.T, triangles, facecolors=faces, cmap="turbo", vmin=low, vmax=high)
        axis.set_title(name, fontsize=9)
        axis.set(**limits, aspect="equal")
        parts[0].colorbar(shown, ax=axis, fraction=0.04, pad=0.01).ax.tick_params(labelsize=8)
    with whole_file(path) as temporary:
        figure.savefig(temporary)


def _show_curves(axes: NDArray, found: Measures, frames_per_second: float, unit: str) -> None:
    """Every measure over time, in seconds; points in the colors of the image."""
    seconds = np.arange(len(found.displacement)) / frames_per_second
    of = found.ranges
    distance, area = (of.distance[:, None], of.area[:, None]) if of else (None, None)
    _plot(axes[0], f"distance of points 0 and 1, {unit}", seconds, found.distance[:, None], "black", distance)
    _plot(axes[1], f"area of the polygon, {unit}²", seconds, found.area[:, None], "black", area)
    moved = f"displacement since frame {found.since}, {unit}"
    _plot(axes[3], moved, seconds, found.displacement, ranges=of and of.displacement)
    _plot(axes[4], f"stretch since frame {found.since}; 1: unchanged", seconds, found.stretch)
    _plot(axes[2], f"path length, {unit}; dotted: without smoothing", seconds, found.path_length)
    for p in range(found.path_length_raw.shape[1]):
        axes[2].plot(seconds, found.path_length_raw[:, p], color=f"C{p}", linewidth=0.8, linestyle=":")
    axes[5].set_axis_off()
    for axis in axes[:5]:
        axis.set_xlabel("s", fontsize=8)
    handles, labels = axes[3].get_legend_handles_labels()
    shown = "point" if of is None else "point; bands hold 95 % of the true values"
    axes[5].legend(handles, labels, title=shown, loc="upper left", fontsize=8, ncols=3)


def _plot(
    axis: Axes,
    title: str,
    seconds: NDArray,
    values: NDArray,
    color: str | None = None,
    ranges: NDArray | None = None,
) -> None:
    """Curves (T, P), with bands of `ranges` to both sides; an empty panel that says so where nothing is known."""
    axis.set_title(title, fontsize=9)
    axis.tick_params(labelsize=8)
    axis.grid(alpha=0.3)
    if not np.isfinite(values).any():
        axis.text(0.5, 0.5, "none", ha="center", color="gray", transform=axis.transAxes)
    for p in range(values.shape[1]):
        axis.plot(seconds, values[:, p], color=color or f"C{p}", linewidth=1.2, label=str(p))
        if ranges is not None:
            low, high = np.maximum(values[:, p] - ranges[:, p], 0), values[:, p] + ranges[:, p]
            axis.fill_between(seconds, low, high, color=color or f"C{p}", alpha=0.15, linewidth=0)
