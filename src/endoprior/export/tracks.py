"""Tracks of chosen material points over the whole sequence, as CSV and NPZ."""

from __future__ import annotations

import csv
import io
import math
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from ..core.checks import input_error
from ..core.geometry import back_project
from ..data import FrameSequence, load_sequence
from ..evaluation.scoring import scored_data
from ..model.carry import carry
from ..model.scene import Scene
from ..model.surface import Surface, depth_at, project_visible, render_surface
from ..system.atomic import whole_folder
from .axes import points_in_axes
from .formats import ExportOptions, Format, Progress

COLUMNS = ("frame", "time", "point", "x", "y", "z", "u", "v", "visible", "confidence")


@dataclass(frozen=True)
class QueryPoints:
    """The points to track: `P` pixels."""

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
    times = [i / len(cameras) for i in range(len(cameras))]
    sequence = None if options.data is None else _sequence_of(scene, options.data)
    with whole_folder(out) as folder:
        if options.points:
            queries = read_query_points(options.points, scene)
        else:
            first = render_surface(scene, times[0], cameras[0], options.min_alpha)
            queries = grid_query_points(first, options.grid_px)
        starts = back_projected(scene, queries, options.min_alpha)
        carried = carry(scene, starts, queries.frames, times)
        pixels = np.empty((len(times), len(starts), 2), np.float32)
        visible = np.empty(pixels.shape[:2], bool)
        for i, camera in enumerate(cameras):
            surface = render_surface(scene, times[i], camera, options.min_alpha)
            mask = sequence.frame(i).tissue_mask if sequence else None
            pixels[i], visible[i] = project_visible(carried.positions[i], surface, mask)
            progress(i + 1, len(cameras))
        positions = points_in_axes(carried.positions, options.frame)
        np.savez_compressed(
            folder / "tracks.npz",
            points=positions,
            pixels=pixels,
            visible=visible,
            confidence=carried.confidence,
            times=np.array(times),
            start_frame=queries.frames,
            start_pixel=queries.pixels,
            axes=np.array(options.frame),
        )
        table = _table(positions, pixels, visible, carried.confidence, times)
        (folder / "tracks.csv").write_text(table, encoding="utf-8", newline="\n")


def _sequence_of(scene: Scene, data: Path) -> FrameSequence:
    """The sequence in the folder `data`.

    Raises:
        InputError: it cannot be read, or it is not the one of the scene.
    """
    sequence, camera = load_sequence(data, scored_data(scene.config.data)), scene.cameras[0]
    own = sequence.camera(0)
    want, got = (len(scene.cameras), camera.width, camera.height), (len(sequence), own.width, own.height)
    if want != got:
        want, got = ("{} frames of {}x{}".format(*size) for size in (want, got))
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
    return QueryPoints(np.array([row[:2] for row in rows]), np.array([row[2] for row in rows], np.intp))


def grid_query_points(surface: Surface, spacing: int) -> QueryPoints:
    """Pixel centers of the first frame, `spacing` px apart, where a surface is all around.

    Raises:
        InputError: there is none.
    """
    rows, columns = (np.arange(spacing // 2, n, spacing) for n in surface.depth.shape)
    row, column = (part.ravel() for part in np.meshgrid(rows, columns, indexing="ij"))
    pixels = np.column_stack([column + 0.5, row + 0.5])
    pixels = pixels[np.isfinite(depth_at(surface, pixels))]
    if not len(pixels):
        raise input_error("--grid-px", "a grid with points on tissue in the first frame", f"{spacing}", "lower it.")
    return QueryPoints(pixels, np.zeros(len(pixels), np.intp))


def back_projected(scene: Scene, queries: QueryPoints, min_alpha: float) -> NDArray[np.float64]:
    """(P, 3) world positions of the query points, mm."""
    positions = np.empty((len(queries.pixels), 3))
    for frame in np.unique(queries.frames):
        own = queries.frames == frame
        camera = scene.cameras[frame]
        surface = render_surface(scene, frame / len(scene.cameras), camera, min_alpha)
        depth = depth_at(surface, queries.pixels[own])
        if not np.isfinite(depth).all():
            point = np.flatnonzero(own)[np.flatnonzero(~np.isfinite(depth))[0]]
            x, y = queries.pixels[point]
            got = f"({x:g}, {y:g}) in frame {frame} for point {point}, where no surface is rendered"
            raise input_error("--points", "pixels that show tissue", got, "move it.")
        positions[own] = back_project(queries.pixels[own], depth, camera)
    return positions


def _table(positions: NDArray, pixels: NDArray, visible: NDArray, confidence: NDArray, times: list[float]) -> str:
    text = io.StringIO()
    rows = csv.writer(text, lineterminator="\n")
    rows.writerow(COLUMNS)
    for i, time in enumerate(times):
        for p in range(positions.shape[1]):
            x, y, z = (f"{value:.4f}" for value in positions[i, p])
            u, v = (f"{value:.3f}" if math.isfinite(value) else "" for value in pixels[i, p])
            rows.writerow((i, f"{time:.6f}", p, x, y, z, u, v, int(visible[i, p]), f"{confidence[i, p]:.3f}"))
    return text.getvalue()


FORMAT = Format(
    suffixes=(), options=("frame", "points", "grid_px", "min_alpha", "data"), write=write, holds="tracks of points"
)
