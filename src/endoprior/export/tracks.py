"""Paths of chosen material points over the whole sequence, as CSV and NPZ."""

from __future__ import annotations

import csv
import io
import math
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from ..core.checks import InputError
from ..core.geometry import back_project, bilinear, project
from ..model.carry import carry_points
from ..model.scene import Scene
from ..system.atomic import whole_folder
from .axes import turned_points
from .options import ExportOptions
from .surface import Surface, seen_surface

COLUMNS = ("frame", "time", "point", "x", "y", "z", "u", "v", "visible")
HIDDEN_SHARE = 0.02
"""A point is hidden if it lies deeper than what is drawn at its pixel by more than this share of its depth."""


@dataclass(frozen=True)
class Picks:
    """Where to start following: `P` pixels."""

    pixels: NDArray[np.float64]
    """(P, 2) x, y, px; pixel (0, 0) is centered at (0.5, 0.5)."""
    frames: NDArray[np.intp]
    """(P,) frame each is picked in."""


def write(scene: Scene, out: Path, options: ExportOptions, progress: Callable[[int, int], None]) -> None:
    """Follow the points and write `out/tracks.csv` and `out/tracks.npz`.

    Raises:
        InputError: the picks cannot be read, or a pick shows no surface.
    """
    cameras = scene.cameras
    times = [i / len(cameras) for i in range(len(cameras))]
    with whole_folder(out) as folder:
        picks = read_picks(options.points, scene) if options.points else None
        first = seen_surface(scene, times[0], cameras[0], options.min_alpha)
        picks = picks or grid_picks(first, options.grid_px)
        starts = _lifted(scene, picks, options.min_alpha)
        carried = carry_points(scene, starts, picks.frames, times)
        pixels = np.empty((len(times), len(starts), 2), np.float32)
        visible = np.empty(pixels.shape[:2], bool)
        for i, camera in enumerate(cameras):
            seen = seen_surface(scene, times[i], camera, options.min_alpha)
            pixels[i], visible[i] = _seen(carried[i], seen)
            progress(i + 1, len(cameras))
        positions = turned_points(carried, options.frame)
        np.savez_compressed(
            folder / "tracks.npz",
            points=positions,
            pixels=pixels,
            visible=visible,
            times=np.array(times),
            start_frame=picks.frames,
            start_pixel=picks.pixels,
            axes=np.array(options.frame),
        )
        (folder / "tracks.csv").write_text(_table(positions, pixels, visible, times), encoding="utf-8")


def read_picks(file: Path, scene: Scene) -> Picks:
    """Read a CSV file with a header that names at least x, y and frame.

    Raises:
        InputError: it is missing, has other columns, no rows, or a row outside the picture or the sequence.
    """
    wanted = f"{file}: expected a CSV file with columns x, y, frame"
    try:
        with file.open(newline="", encoding="utf-8-sig") as text:
            rows = [(float(row["x"]), float(row["y"]), int(row["frame"])) for row in csv.DictReader(text)]
    except (OSError, ValueError, KeyError, TypeError, csv.Error) as error:
        raise InputError(f"{wanted}; got {error!r}. Correct the file.") from None
    if not rows:
        raise InputError(f"{wanted}; got no rows. Add one.")
    camera, total = scene.cameras[0], len(scene.cameras)
    for k, (x, y, frame) in enumerate(rows):
        if not (0 <= x <= camera.width and 0 <= y <= camera.height and 0 <= frame < total):
            raise InputError(
                f"{file}: expected x in [0, {camera.width}], y in [0, {camera.height}], frame in 0..{total - 1}; "
                f"got {x:g}, {y:g}, {frame} for point {k}. Correct the row."
            )
    return Picks(np.array([row[:2] for row in rows]), np.array([row[2] for row in rows], np.intp))


def grid_picks(seen: Surface, spacing: int) -> Picks:
    """Pixel centers of the first frame, `spacing` px apart, where all around shows a surface.

    Raises:
        InputError: there is none.
    """
    rows, columns = (np.arange(spacing // 2, n, spacing) for n in seen.depth.shape)
    row, column = (part.ravel() for part in np.meshgrid(rows, columns, indexing="ij"))
    shown = np.isfinite(_depth_at(seen, np.column_stack([column + 0.5, row + 0.5])))
    if not shown.any():
        raise InputError(f"--grid-px: expected a grid that meets tissue in the first frame; got {spacing}. Lower it.")
    pixels = np.column_stack([column + 0.5, row + 0.5])[shown]
    return Picks(pixels, np.zeros(len(pixels), np.intp))


def _depth_at(seen: Surface, pixels: NDArray) -> NDArray[np.float64]:
    """(P,) depth between the pixel centers around; NaN where one of them shows no surface."""
    depth = np.where(seen.depth > 0, seen.depth, np.nan).astype(np.float64)
    return bilinear(depth, pixels)


def _lifted(scene: Scene, picks: Picks, min_alpha: float) -> NDArray[np.float64]:
    """(P, 3) world positions of the picks, mm."""
    found = np.empty((len(picks.pixels), 3))
    for frame in np.unique(picks.frames):
        own = picks.frames == frame
        camera = scene.cameras[frame]
        seen = seen_surface(scene, frame / len(scene.cameras), camera, min_alpha)
        depth = _depth_at(seen, picks.pixels[own])
        if not np.isfinite(depth).all():
            point = np.flatnonzero(own)[np.flatnonzero(~np.isfinite(depth))[0]]
            x, y = picks.pixels[point]
            raise InputError(
                f"--points: expected pixels that show tissue; got ({x:g}, {y:g}) in frame {frame} for point {point}, "
                "where nothing is drawn. Move it."
            )
        found[own] = back_project(picks.pixels[own], depth, camera)
    return found


def _seen(points: NDArray, seen: Surface) -> tuple[NDArray, NDArray[np.bool_]]:
    """(P, 2) pixels of world points (P, 3), and (P,) whether they are inside the picture and not behind tissue."""
    pixels, z = project(points.astype(np.float64), seen.camera)
    inside = (z > 0) & (pixels >= 0).all(1) & (pixels <= (seen.camera.width, seen.camera.height)).all(1)
    depth = _depth_at(seen, pixels)
    with np.errstate(invalid="ignore"):  # NaN: nothing is drawn there, and nothing can be seen
        return pixels, inside & (z <= depth * (1 + HIDDEN_SHARE))


def _table(positions: NDArray, pixels: NDArray, visible: NDArray, times: list[float]) -> str:
    text = io.StringIO()
    rows = csv.writer(text, lineterminator="\n")
    rows.writerow(COLUMNS)
    for i, time in enumerate(times):
        for p in range(positions.shape[1]):
            x, y, z = (f"{value:.4f}" for value in positions[i, p])
            u, v = (f"{value:.3f}" if math.isfinite(value) else "" for value in pixels[i, p])
            rows.writerow((i, f"{time:.6f}", p, x, y, z, u, v, int(visible[i, p])))
    return text.getvalue()
