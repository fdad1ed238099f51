"""Measures over time of chosen points, and maps of displacement and stretch of the surface between two frames.

ParaView plays the surface over time: `.vtp` for one time, `.pvd` for the times together. Source: VTK's documentation of
its XML file formats. An array is the Base64 of its length in bytes, 64 bits, and itself. `T` frames, `V` vertices.
"""

from __future__ import annotations

import base64
from collections.abc import Mapping
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from ..core.checks import input_error
from ..core.geometry import length_unit, project, unit_vectors
from ..core.types import frame_times
from ..model.carry import CarriedPoints, carry
from ..model.measures import SurfaceMotion, distance, measures_of
from ..model.scene import Scene
from ..model.surface import render_surface
from ..model.uncertainty import point_errors
from ..system.atomic import whole_folder
from ..visualization.measures import displacement_span, measures_csv, stretch_span, value_colors, write_figure
from .axes import points_in_axes
from .formats import ExportFormat, ExportOptions, Progress
from .mesh import depth_grid
from .ply import colored, ply_bytes
from .tracks import back_projected, read_query_points

SURFACES = "surface"
"""Name of the series for ParaView, and of the folder of its files."""
VTK_KINDS = {"<f4": "Float32", "<i4": "Int32"}
VTK_HEAD = '<?xml version="1.0"?>\n<VTKFile type="{}" version="1.0" byte_order="LittleEndian" header_type="UInt64">'


def write(scene: Scene, out: Path, options: ExportOptions, progress: Progress) -> None:
    """Write the surface over time, `displacement.ply`, `stretch.ply`, `measures.png`; with points `measures.csv`.

    Raises:
        InputError: a frame is not in the sequence, the file of points cannot be read, or a point or the whole frame
            shows no surface.
    """
    num_frames, rate, unit = len(scene.cameras), scene.frames_per_second, length_unit(scene.lengths_are_relative)
    since, until = _frames(options, num_frames)
    times, camera = frame_times(num_frames), scene.cameras[since]
    surface = render_surface(scene, times[since], camera, options.min_alpha)
    mesh = depth_grid(surface, options.mesh_step, options.max_slope)
    if not len(mesh.triangles):
        fix = "choose another, or lower --min-alpha."
        raise input_error("--from-frame", "a frame that shows tissue", f"{since}", fix)
    motion = SurfaceMotion(scene, since, options.min_alpha)
    frames = list(range(min(since, until), max(since, until) + 1))
    at_since = np.zeros(len(mesh.vertices), np.intp)
    carried = carry(scene, mesh.vertices, at_since, [times[since], *(times[frame] for frame in frames)])
    moved, ends = carried.positions[1:], [0, 1 + frames.index(until)]
    both = CarriedPoints(carried.positions[ends], carried.spread_px[ends])
    strain = motion.strain(mesh.vertices.astype(np.float64), frames)
    values = {  # (T, V) each: straight distance, mm, and largest principal stretch, NaN where unknown
        "displacement": np.stack([distance(there, mesh.vertices) for there in moved]),
        "stretch": strain.stretch[..., 0],
    }
    others = {
        "stretch_smallest": strain.stretch[..., 1],
        "area_change": strain.area,
        "direction": points_in_axes(strain.direction, options.axes),
    }
    maps = {name: each[frames.index(until)] for name, each in values.items()}
    spans = displacement_span(maps["displacement"]), stretch_span(maps["stretch"])
    way = unit_vectors(moved[ends[1] - 1] - mesh.vertices)
    sure_to = point_errors(scene, both, at_since, [since, until]).half_width(np.stack([way, way]), since_pick=True)[1]
    with whole_folder(out) as folder:
        (folder / SURFACES).mkdir()
        about, files = f"axes {options.axes}, unit {unit}", []
        for k, frame in enumerate(frames):
            place, now = (
                points_in_axes(moved[k], options.axes),
                {name: each[k] for name, each in (values | others).items()},
            )
            files.append(f"{SURFACES}/{frame:06d}.vtp")
            (folder / files[-1]).write_bytes(vtp_bytes(place, mesh.triangles, now, about))
            progress(k, len(frames))
        (folder / f"{SURFACES}.pvd").write_bytes(pvd_bytes({f: i / rate for f, i in zip(files, frames, strict=True)}))
        positions = points_in_axes(mesh.vertices, options.axes)
        # In the colors of one map, with the values of both.
        for (name, shown), span in zip(maps.items(), spans, strict=True):
            columns = colored(positions, value_colors(shown, span)) | maps | {"displacement_range95": sure_to}
            (folder / f"{name}.ply").write_bytes(ply_bytes(columns, options.axes, unit, mesh.triangles))
        points, curves = np.zeros((0, 2)), None
        if options.points:
            queries = read_query_points(options.points, scene)
            followed = carry(scene, back_projected(scene, queries, options.min_alpha), queries.frames, times)
            paths = followed.positions
            around = motion.stretch(paths[since].astype(np.float64), list(range(num_frames)))
            errors = point_errors(scene, followed, queries.frames, range(num_frames))
            found = measures_of(paths, around, since, int(queries.frames[-1]), errors)
            table = measures_csv(found, rate, unit, errors.confidence)
            (folder / "measures.csv").write_text(table, encoding="utf-8", newline="\n")
            points, curves = project(paths[since].astype(np.float64), camera)[0], (found, rate, unit)
        on_image = project(mesh.vertices.astype(np.float64), camera)[0], mesh.triangles
        titles = f"displacement, {unit}", "largest principal stretch; 1: unchanged"
        shown = dict(zip(titles, zip(maps.values(), spans, strict=True), strict=True))
        title = f"frame {since} to frame {until}"
        write_figure(folder / "measures.png", title, surface.color, points, on_image, shown, curves)
    progress(len(frames), len(frames))


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
