"""Measures over time of chosen points, and maps of displacement and stretch of the surface between two frames.

ParaView plays the surface over time: `.vtp` for one time, `.pvd` for the times together. Source: VTK's documentation of
its XML file formats. An array is the Base64 of its length in bytes, 64 bits, and itself. `T` frames, `V` vertices.
"""

from __future__ import annotations

import base64
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from ..core.checks import input_error
from ..core.geometry import Strain, length_unit, project, unit_vectors
from ..core.types import frame_times
from ..model.carry import CarriedPoints, carry
from ..model.measures import Measures, SurfaceMotion, distance, measures_of
from ..model.scene import Scene
from ..model.surface import Surface, render_surface
from ..model.uncertainty import point_errors
from ..system.atomic import whole_folder
from ..visualization.measures import displacement_span, measures_csv, stretch_span, value_colors, write_figure
from .axes import points_in_axes
from .formats import Axes, ExportFormat, ExportOptions, Progress
from .mesh import depth_grid
from .ply import colored, ply_bytes
from .tracks import back_projected, read_query_points

SURFACES = "surface"
"""Name of the series for ParaView, and of the folder of its files."""
VTK_KINDS = {"<f4": "Float32", "<i4": "Int32"}
VTK_HEAD = '<?xml version="1.0"?>\n<VTKFile type="{}" version="1.0" byte_order="LittleEndian" header_type="UInt64">'


@dataclass(frozen=True)
class MovingSurface:
    """The surface that frame `since` shows, and where and how deformed it is in each of `frames`."""

    since: int
    until: int
    frames: list[int]
    """All from the first to the last of the two."""
    shown: Surface
    """What frame `since` shows."""
    vertices: NDArray[np.float32]
    """(V, 3) in frame `since`, world axes, mm."""
    triangles: NDArray[np.int32]
    """(F, 3) vertex numbers."""
    moved: NDArray[np.float32]
    """(T, V, 3) the vertices in each frame."""
    displacement: NDArray[np.floating]
    """(T, V) straight distance from frame `since`, mm; NaN where unknown, as in what follows."""
    strain: Strain
    """(T, V) since frame `since`."""
    range95: NDArray[np.float64]
    """(V,) half of the range of the displacement at `until`, mm."""

    @property
    def maps(self) -> dict[str, NDArray]:
        """(V,) displacement and largest principal stretch at `until`."""
        end = self.frames.index(self.until)
        return {"displacement": self.displacement[end], "stretch": self.strain.stretch[end, :, 0]}


def moving_surface(scene: Scene, options: ExportOptions) -> MovingSurface:
    """Carry the surface of a frame along.

    Raises:
        InputError: a frame is not in the sequence, or shows no surface.
    """
    num_frames = len(scene.cameras)
    since, until = _frames(options, num_frames)
    times = frame_times(num_frames)
    shown = render_surface(scene, times[since], scene.cameras[since], options.min_alpha)
    mesh = depth_grid(shown, options.mesh_step, options.max_slope)
    if not len(mesh.triangles):
        fix = "choose another, or lower --min-alpha."
        raise input_error("--from-frame", "a frame that shows tissue", f"{since}", fix)
    frames = list(range(min(since, until), max(since, until) + 1))
    at_since = np.zeros(len(mesh.vertices), np.intp)
    carried = carry(scene, mesh.vertices, at_since, [times[since], *(times[frame] for frame in frames)])
    moved, ends = carried.positions[1:], [0, 1 + frames.index(until)]
    both = CarriedPoints(carried.positions[ends], carried.spread_px[ends])
    way = unit_vectors(moved[frames.index(until)] - mesh.vertices)
    errors = point_errors(scene, both, at_since, [since, until])
    return MovingSurface(
        since,
        until,
        frames,
        shown,
        mesh.vertices,
        mesh.triangles,
        moved,
        displacement=np.stack([distance(there, mesh.vertices) for there in moved]),
        strain=SurfaceMotion(scene, since, options.min_alpha).strain(mesh.vertices.astype(np.float64), frames),
        range95=errors.half_width(np.stack([way, way]), since_pick=True)[1],
    )


def write(scene: Scene, out: Path, options: ExportOptions, progress: Progress) -> None:
    """Write the surface over time, `displacement.ply`, `stretch.ply`, `measures.png`; with points `measures.csv`.

    Raises:
        InputError: a frame is not in the sequence, the file of points cannot be read, or a point or the whole frame
            shows no surface.
    """
    surface = moving_surface(scene, options)
    rate, unit = scene.frames_per_second, length_unit(scene.lengths_are_relative)
    camera, maps = scene.cameras[surface.since], surface.maps
    spans = displacement_span(maps["displacement"]), stretch_span(maps["stretch"])
    with whole_folder(out) as folder:
        _write_series(surface, folder, options.axes, unit, rate, progress)
        positions = points_in_axes(surface.vertices, options.axes)
        # In the colors of one map, with the values of both.
        for (name, values), span in zip(maps.items(), spans, strict=True):
            columns = colored(positions, value_colors(values, span)) | maps | {"displacement_range95": surface.range95}
            (folder / f"{name}.ply").write_bytes(ply_bytes(columns, options.axes, unit, surface.triangles))
        points, curves = np.zeros((0, 2)), None
        if options.points:
            paths, found, confidence = _measured(scene, options, surface.since)
            table = measures_csv(found, rate, unit, confidence)
            (folder / "measures.csv").write_text(table, encoding="utf-8", newline="\n")
            points, curves = project(paths[surface.since].astype(np.float64), camera)[0], (found, rate, unit)
        on_image = project(surface.vertices.astype(np.float64), camera)[0], surface.triangles
        titles = f"displacement, {unit}", "largest principal stretch; 1: unchanged"
        shown = dict(zip(titles, zip(maps.values(), spans, strict=True), strict=True))
        title = f"frame {surface.since} to frame {surface.until}"
        write_figure(folder / "measures.png", title, surface.shown.color, points, on_image, shown, curves)
    progress(len(surface.frames), len(surface.frames))


def _write_series(surface: MovingSurface, folder: Path, axes: Axes, unit: str, rate: float, progress: Progress) -> None:
    """Write the surface at each frame, and the list of these files for ParaView."""
    values = {
        "displacement": surface.displacement,
        "stretch": surface.strain.stretch[..., 0],
        "stretch_smallest": surface.strain.stretch[..., 1],
        "area_change": surface.strain.area,
        "direction": points_in_axes(surface.strain.direction, axes),
    }
    (folder / SURFACES).mkdir()
    seconds: dict[str, float] = {}
    for k, frame in enumerate(surface.frames):
        file, now = f"{SURFACES}/{frame:06d}.vtp", {name: each[k] for name, each in values.items()}
        about, place = f"axes {axes}, unit {unit}", points_in_axes(surface.moved[k], axes)
        (folder / file).write_bytes(vtp_bytes(place, surface.triangles, now, about))
        seconds[file] = frame / rate
        progress(k, len(surface.frames))
    (folder / f"{SURFACES}.pvd").write_bytes(pvd_bytes(seconds))


def _measured(scene: Scene, options: ExportOptions, since: int) -> tuple[NDArray, Measures, NDArray[np.float32]]:
    """Of the points of the options: (T, P, 3) their paths, mm, the measures since a frame, (T, P) confidence."""
    assert options.points is not None, "no file of points"
    num_frames, queries = len(scene.cameras), read_query_points(options.points, scene)
    times = frame_times(num_frames)
    followed = carry(scene, back_projected(scene, queries, options.min_alpha), queries.frames, times)
    paths, motion = followed.positions, SurfaceMotion(scene, since, options.min_alpha)
    around = motion.stretch(paths[since].astype(np.float64), list(range(num_frames)))
    errors = point_errors(scene, followed, queries.frames, range(num_frames))
    return paths, measures_of(paths, around, since, int(queries.frames[-1]), errors), errors.confidence


def _frames(options: ExportOptions, num_frames: int) -> tuple[int, int]:
    """The two frames of the options; InputError unless they are two frames of the sequence."""
    since, until = options.from_frame, num_frames - 1 if options.to_frame is None else options.to_frame
    for name, frame in (("--from-frame", since), ("--to-frame", until)):
        if not 0 <= frame < num_frames:
            raise input_error(name, f"a frame in 0..{num_frames - 1}", f"{frame}", "choose another.")
    if since == until:
        raise input_error("--to-frame", f"another frame than --from-frame {since}", f"{until}", "choose another.")
    return since, until


def vtp_bytes(
    vertices: NDArray[np.float32], triangles: NDArray[np.int32], values: Mapping[str, NDArray], about: str
) -> bytes:
    """A surface as VTK's PolyData.

    Args:
        vertices: (V, 3), in the axes of the file. triangles: (F, 3) vertex numbers.
        values: (V,) or (V, 3) each, by the name under which programs list them; the first is shown. NaN where unknown.
        about: a comment on axes and unit.
    """
    ends = 3 * np.arange(1, len(triangles) + 1, dtype="<i4")
    lines = [
        VTK_HEAD.format("PolyData"),
        f"<!-- {about} -->",
        f'<PolyData><Piece NumberOfPoints="{len(vertices)}" NumberOfVerts="0" NumberOfLines="0" NumberOfStrips="0" '
        f'NumberOfPolys="{len(triangles)}">',
        f'<PointData Scalars="{next(iter(values))}">',
        *(_array(name, column.astype("<f4")) for name, column in values.items()),
        "</PointData>",
        f"<Points>{_array('Points', vertices.astype('<f4'))}</Points>",
        f"<Polys>{_array('connectivity', triangles.astype('<i4').ravel())}{_array('offsets', ends)}</Polys>",
        "</Piece></PolyData>\n</VTKFile>\n",
    ]
    return "\n".join(lines).encode()


def pvd_bytes(files: Mapping[str, float]) -> bytes:
    """The list of the files of a series, relative to it, with the time of each, s."""
    sets = [f'<DataSet timestep="{time:.9g}" part="0" file="{file}"/>' for file, time in files.items()]
    return "\n".join([VTK_HEAD.format("Collection"), "<Collection>", *sets, "</Collection>\n</VTKFile>\n"]).encode()


def _array(name: str, array: NDArray) -> str:
    """One array, of rows of 1 or 3 numbers."""
    body = base64.b64encode(np.uint64(array.nbytes).tobytes() + array.tobytes()).decode()
    rows = f' NumberOfComponents="{array.shape[1]}"' if array.ndim == 2 else ""
    return f'<DataArray type="{VTK_KINDS[array.dtype.str]}" Name="{name}"{rows} format="binary">{body}</DataArray>'


FORMAT = ExportFormat(
    (),
    ("frame", "points", "from_frame", "to_frame", "mesh_step", "max_slope", "min_alpha"),
    write=write,
    holds="measures over time",
)
