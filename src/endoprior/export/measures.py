"""Measures over time of chosen points, and maps of displacement and stretch of the surface between two frames."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from ..core.checks import input_error
from ..core.geometry import length_unit, project
from ..model.carry import carry, carry_points
from ..model.measures import SurfaceMotion, distance, measures_of
from ..model.scene import Scene
from ..model.surface import render_surface
from ..system.atomic import whole_folder
from ..visualization.measures import MeasuresFigure, displacement_span, measures_csv, stretch_span, value_colors
from .axes import points_in_axes
from .formats import Axes, Format, Progress
from .mesh import Mesh, depth_grid
from .options import ExportOptions
from .ply import ply_bytes, vertex_table
from .tracks import back_projected, read_query_points
from .vtk_files import pvd_bytes, vtp_bytes

SURFACES = "surface"
"""Name of the series for ParaView, and of the folder of its files."""


def write(scene: Scene, out: Path, options: ExportOptions, progress: Progress) -> None:
    """Write the surface over time, `displacement.ply`, `stretch.ply`, `measures.png`; with points `measures.csv`.

    Raises:
        InputError: a frame is not in the sequence, the file of points cannot be read, or a point or the whole frame
            shows no surface.
    """
    last = len(scene.cameras) - 1
    since, until = options.from_frame, last if options.to_frame is None else options.to_frame
    for name, frame in (("--from-frame", since), ("--to-frame", until)):
        if not 0 <= frame <= last:
            raise input_error(name, f"a frame in 0..{last}", f"{frame}", "choose another.")
    if since == until:
        raise input_error("--to-frame", f"another frame than --from-frame {since}", f"{until}", "choose another.")
    times, rate, unit = (
        [i / (last + 1) for i in range(last + 1)],
        scene.frames_per_second,
        length_unit(scene.lengths_are_relative),
    )
    camera = scene.cameras[since]
    surface = render_surface(scene, times[since], camera, options.min_alpha)
    mesh = depth_grid(surface, options.mesh_step, options.max_slope)
    if not len(mesh.triangles):
        raise input_error(
            "--from-frame", "a frame that shows tissue", f"{since}", "choose another, or lower --min-alpha."
        )
    motion = SurfaceMotion(scene, since, options.min_alpha)
    frames = list(range(min(since, until), max(since, until) + 1))
    surfaces = _carried(scene, mesh, motion, frames)
    shown = surfaces.values(frames.index(until))
    spans = (displacement_span, stretch_span)
    maps = {name: _Map(one, span(one)) for (name, one), span in zip(shown.items(), spans, strict=True)}
    with whole_folder(out) as folder:
        (folder / SURFACES).mkdir()
        for k, frame in enumerate(frames):
            place, about = points_in_axes(surfaces.positions[k], options.frame), f"axes {options.frame}, unit {unit}"
            content = vtp_bytes(place, mesh.triangles, surfaces.values(k), about)
            (folder / SURFACES / f"{frame:06d}.vtp").write_bytes(content)
            progress(k, len(frames))
        files = [f"{SURFACES}/{frame:06d}.vtp" for frame in frames]
        (folder / f"{SURFACES}.pvd").write_bytes(pvd_bytes(files, [frame / rate for frame in frames]))
        for name, one in maps.items():
            (folder / f"{name}.ply").write_bytes(_colored_mesh(mesh, maps, one, options.frame, unit))
        figure = MeasuresFigure(f"frame {since} to frame {until}", with_curves=options.points is not None)
        pixels = np.zeros((0, 2))
        if options.points:
            queries = read_query_points(options.points, scene)
            starts = back_projected(scene, queries, options.min_alpha)
            carried = carry(scene, starts, queries.frames, times)
            paths = carried.positions
            around = motion.stretch(paths[since].astype(np.float64), list(range(len(times))))
            found = measures_of(paths, around, since, drawn=int(queries.frames[-1]))
            table = measures_csv(found, rate, unit, carried.confidence)
            (folder / "measures.csv").write_text(table, encoding="utf-8", newline="\n")
            figure.show_curves(found, rate, unit)
            pixels = project(paths[since].astype(np.float64), camera)[0]
        figure.show_points(surface.color, pixels)
        on_image = project(mesh.vertices.astype(np.float64), camera)[0]
        titles = f"displacement, {unit}", "largest principal stretch; 1: unchanged"
        for place, (title, one) in enumerate(zip(titles, maps.values(), strict=True), 1):
            figure.show_map(place, title, on_image, mesh.triangles, one.values, one.span)
        figure.save(folder / "measures.png")
    progress(len(frames), len(frames))


@dataclass(frozen=True)
class _Surfaces:
    """The vertices of a mesh at `T` frames."""

    positions: NDArray[np.float32]
    """(T, V, 3) world axes, mm."""
    displacement: NDArray
    """(T, V) straight distance from where they were in the first one, mm."""
    stretch: NDArray
    """(T, V) largest principal stretch since then; NaN where unknown."""

    def values(self, k: int) -> dict[str, NDArray]:
        """(V,) values at frame k, by name."""
        return {"displacement": self.displacement[k], "stretch": self.stretch[k]}


@dataclass(frozen=True)
class _Map:
    """A value for each vertex, and the ends of its color scale."""

    values: NDArray
    span: tuple[float, float]


def _carried(scene: Scene, mesh: Mesh, motion: SurfaceMotion, frames: list[int]) -> _Surfaces:
    """The vertices of the mesh of the frame of `motion`, carried to other frames."""
    times = [frame / len(scene.cameras) for frame in (motion.since, *frames)]
    moved = carry_points(scene, mesh.vertices, np.zeros(len(mesh.vertices), np.intp), times)[1:]
    displacement = np.stack([distance(there, mesh.vertices) for there in moved])
    return _Surfaces(moved, displacement, motion.stretch(mesh.vertices.astype(np.float64), frames))


def _colored_mesh(mesh: Mesh, maps: dict[str, _Map], shown: _Map, axes: Axes, unit: str) -> bytes:
    """A PLY file in the colors of one map, with the values of all."""
    columns = dict(zip("xyz", points_in_axes(mesh.vertices, axes).T, strict=True))
    columns |= dict(zip(("red", "green", "blue"), value_colors(shown.values, shown.span).T, strict=True))
    columns |= {name: one.values for name, one in maps.items()}
    return ply_bytes(vertex_table(columns), axes, unit, mesh.triangles)


FORMAT = Format(
    suffixes=(),
    options=("frame", "points", "from_frame", "to_frame", "mesh_step", "max_slope", "min_alpha"),
    write=write,
    holds="measures over time",
)
