"""Tracks of chosen material points over the whole sequence, as CSV and NPZ. `P` points."""

from __future__ import annotations

import csv
import io
from pathlib import Path
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from ..core.checks import input_error
from ..core.types import frame_times
from ..data import FrameSequence, load_sequence
from ..evaluation.scoring import scored_data
from ..model.carry import carry
from ..model.scene import Scene
from ..model.surface import Surface, depth_at, project_visible, render_surface, surface_points
from ..model.uncertainty import LEVEL, point_errors
from ..system.atomic import whole_folder
from .axes import points_in_axes
from .formats import ExportFormat, ExportOptions, Progress

COLUMNS = ("frame", "time", "point", "x", "y", "z", "u", "v", "visible", "confidence", "across95", "along95")


class QueryPoints(NamedTuple):
    """The points to track."""

    pixels: NDArray[np.float64]
    """(P, 2) x, y, px; pixel (0, 0) is centered at (0.5, 0.5)."""
    frames: NDArray[np.intp]
    """(P,) frame of each pixel."""


def write(scene: Scene, out: Path, options: ExportOptions, progress: Progress) -> None:
    """Track the points and write `out/tracks.csv` and `out/tracks.npz`.

    Raises:
        InputError: the file of query points or the sequence cannot be read, or a query point shows no surface.
    """
    cameras = scene.cameras
    times = frame_times(len(cameras))
    sequence = None if options.data is None else _sequence_of(scene, options.data)
    with whole_folder(out) as folder:
        if options.points:
            queries = read_query_points(options.points, scene)
        else:
            first = render_surface(scene, times[0], cameras[0], options.min_alpha)
            queries = grid_query_points(first, options.grid_px)
        carried = carry(scene, back_projected(scene, queries, options.min_alpha), queries.frames, times)
        errors = point_errors(scene, carried, queries.frames, range(len(cameras)))
        ranges = errors.across.half_width(LEVEL), errors.along()
        pixels = np.empty((*errors.confidence.shape, 2), np.float32)
        visible = np.empty(errors.confidence.shape, bool)
        for i, camera in enumerate(cameras):
            surface = render_surface(scene, times[i], camera, options.min_alpha)
            mask = sequence.frame(i).tissue_mask if sequence else None
            pixels[i], visible[i] = project_visible(carried.positions[i], surface, mask)
            progress(i + 1, len(cameras))
        positions = points_in_axes(carried.positions, options.axes)
        np.savez_compressed(
            folder / "tracks.npz",
            points=positions,
            pixels=pixels,
            visible=visible,
            confidence=errors.confidence,
            across95=ranges[0].astype(np.float32),
            along95=ranges[1].astype(np.float32),
            times=np.array(times),
            start_frame=queries.frames,
            start_pixel=queries.pixels,
            axes=np.array(options.axes),
        )
        table = _table(positions, pixels, visible, errors.confidence, *ranges)
        (folder / "tracks.csv").write_text(table, encoding="utf-8", newline="\n")


def _sequence_of(scene: Scene, data: Path) -> FrameSequence:
    """The sequence in the folder `data`; InputError if it cannot be read, or is not the one of the scene."""
    sequence = load_sequence(data, scored_data(scene.config.data))
    want, got = (
        f"{num} frames of {camera.width}x{camera.height}"
        for num, camera in ((len(scene.cameras), scene.cameras[0]), (len(sequence), sequence.camera(0)))
    )
    if want != got:
        raise input_error(data, want, got, "pass the sequence of the run.")
    return sequence


def read_query_points(file: Path, scene: Scene) -> QueryPoints:
    """Read a CSV file with a header that names at least x, y and frame.

    Raises:
        InputError: it is missing, has other columns, no rows, or a row outside the image or the sequence.
    """
    wanted = "a CSV file with columns x, y, frame"
    try:
        with file.open(newline="", encoding="utf-8-sig") as text:
            rows = [(float(row["x"]), float(row["y"]), int(row["frame"])) for row in csv.DictReader(text)]
    except (OSError, ValueError, KeyError, TypeError, csv.Error) as error:
        raise input_error(file, wanted, repr(error), "correct the file.") from None
    if not rows:
        raise input_error(file, wanted, "no rows", "add one.")
    camera, total = scene.cameras[0], len(scene.cameras)
    for k, (x, y, frame) in enumerate(rows):
        if not (0 <= x <= camera.width and 0 <= y <= camera.height and 0 <= frame < total):
            want = f"x in [0, {camera.width}], y in [0, {camera.height}], frame in 0..{total - 1}"
            raise input_error(file, want, f"{x:g}, {y:g}, {frame} for point {k}", "correct the row.")
    x, y, frames = zip(*rows, strict=True)
    return QueryPoints(np.column_stack([x, y]), np.array(frames, np.intp))


def grid_query_points(surface: Surface, spacing: int) -> QueryPoints:
    """Pixel centers of the first frame, `spacing` px apart, where a surface is all around; InputError if none is."""
    height, width = surface.depth.shape
    rows, columns = np.mgrid[spacing // 2 : height : spacing, spacing // 2 : width : spacing]
    pixels = np.column_stack([columns.ravel() + 0.5, rows.ravel() + 0.5])
    pixels = pixels[np.isfinite(depth_at(surface, pixels))]
    if not len(pixels):
        raise input_error("--grid-px", "a grid with points on tissue in the first frame", f"{spacing}", "lower it.")
    return QueryPoints(pixels, np.zeros(len(pixels), np.intp))


def back_projected(scene: Scene, queries: QueryPoints, min_alpha: float) -> NDArray[np.float64]:
    """(P, 3) world positions of the query points, mm; InputError for one that shows no surface."""
    positions = surface_points(scene, queries.pixels, queries.frames, min_alpha)
    missing = np.isnan(positions).any(1)
    if missing.any():
        point = missing.argmax()
        x, y = queries.pixels[point]
        got = f"({x:g}, {y:g}) in frame {queries.frames[point]} for point {point}, where no surface is rendered"
        raise input_error("--points", "pixels that show tissue", got, "move it.")
    return positions


def _table(
    positions: NDArray, pixels: NDArray, visible: NDArray, confidence: NDArray, across95: NDArray, along95: NDArray
) -> str:
    text = io.StringIO()
    rows = csv.writer(text, lineterminator="\n")
    rows.writerow(COLUMNS)
    for i, p in np.ndindex(visible.shape):
        xyz = (f"{value:.4f}" for value in positions[i, p])
        uv = (f"{value:.3f}" if np.isfinite(value) else "" for value in pixels[i, p])
        time, shown = f"{i / len(visible):.6f}", int(visible[i, p])
        ranges = (f"{value[i, p]:.4f}" if np.isfinite(value[i, p]) else "" for value in (across95, along95))
        rows.writerow((i, time, p, *xyz, *uv, shown, f"{confidence[i, p]:.3f}", *ranges))
    return text.getvalue()


FORMAT = ExportFormat((), ("frame", "points", "grid_px", "min_alpha", "data"), write=write, holds="tracks of points")
