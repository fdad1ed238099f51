"""Surface meshes: a grid mesh of the depth at one time, or the depths of all cameras fused; as PLY, OBJ and STL.

Triangles turn counterclockwise as seen from the camera, so normals point at it. `V` vertices, `F` triangles.

Sources: Curless and Levoy, "A volumetric method for building complex models from range images", SIGGRAPH 1996; Doi and
Koide, 1991, for tetrahedra, which leave no ambiguous case. Wavefront, "Object Files (.obj)", with colors after the
coordinates as is customary; 3D Systems, "StereoLithography Interface Specification", 1989.
"""

from __future__ import annotations

import io
import struct
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.ndimage import maximum_filter, minimum_filter
from scipy.sparse import coo_array
from scipy.sparse.csgraph import connected_components

from ..core.checks import input_error
from ..core.geometry import back_project, length_unit, pixel_centers, project
from ..core.ranges import evenly_spaced
from ..core.types import Camera
from ..model.scene import Scene
from ..model.surface import Surface, render_surface
from .axes import points_in_axes
from .formats import TIME_STEP_OPTIONS, Axes, ExportFormat, ExportOptions
from .ply import colored, ply_bytes
from .time_steps import TimeStep

SURFACE_OPTIONS = ("mesh_method", "mesh_step", "max_slope", "voxel_mm", "min_alpha")
"""What `surface_mesh` uses."""


@dataclass(frozen=True)
class Mesh:
    """Triangles with colored corners."""

    vertices: NDArray[np.float32]
    """(V, 3) mm."""
    triangles: NDArray[np.int32]
    """(F, 3) vertex numbers."""
    colors: NDArray[np.uint8]
    """(V, 3) red, green, blue."""


def files(scene: Scene, step: TimeStep, options: ExportOptions) -> dict[str, bytes]:
    """The mesh of one time step in the file format of the options; errors as in `surface_mesh`."""
    kind, unit = options.mesh_format or "ply", length_unit(scene.lengths_are_relative)
    return {f".{kind}": encode_mesh(surface_mesh(scene, step, options), kind, options.axes, unit)}


def surface_mesh(scene: Scene, step: TimeStep, options: ExportOptions) -> Mesh:
    """The tissue surface at one time, by the method of the options; world axes, mm.

    Raises:
        InputError: no surface is rendered, or a fusion has fewer than two camera positions.
    """
    if options.mesh_method == "tsdf":
        shown = scene.shown_at(step.time)  # cameras of other windows look elsewhere
        cameras = scene.cameras[shown[0].window.start : shown[-1].window.stop]
        views = [render_surface(scene, step.time, c, options.min_alpha) for c in viewpoints(cameras)]
        mesh = fused_mesh(views, options.voxel_mm)
    else:
        surface = render_surface(scene, step.time, step.camera(scene), options.min_alpha)
        mesh = depth_grid(surface, options.mesh_step, options.max_slope)
    if not len(mesh.triangles):
        want = f"a value that leaves a surface at time {step.time:.3f}"
        raise input_error("--min-alpha", want, f"{options.min_alpha}", "lower it, or raise --max-slope.")
    return mesh


def encode_mesh(mesh: Mesh, kind: str, axes: Axes, unit: str = "mm") -> bytes:
    """A mesh in OpenCV axes as the bytes of a file in `axes`, a `kind` ply, obj or stl; the file names the unit."""
    vertices = points_in_axes(mesh.vertices, axes)
    if kind == "ply":
        return ply_bytes(colored(vertices, mesh.colors), axes, unit, mesh.triangles)
    # `SPACE=LPS` or `SPACE=RAS` is what 3D Slicer looks for.
    about = f"endoprior, axes {axes}, unit {unit}" + (f", SPACE={axes.upper()}" if axes in ("lps", "ras") else "")
    if kind == "obj":
        text = io.StringIO(f"# {about}\n")
        text.seek(0, io.SEEK_END)
        np.savetxt(text, np.column_stack([vertices, mesh.colors / 255]), "v %.6g %.6g %.6g %.4f %.4f %.4f")
        np.savetxt(text, mesh.triangles + 1, "f %d %d %d")
        return text.getvalue().encode()
    corners = vertices[mesh.triangles]
    normals = _normals(corners)
    length = np.linalg.norm(normals, axis=1, keepdims=True)
    facets = np.zeros(len(corners), [("normal", "<f4", 3), ("corners", "<f4", (3, 3)), ("attribute", "<u2")])
    facets["normal"], facets["corners"] = normals / np.where(length > 0, length, 1), corners
    # The header must not begin with "solid": readers would take the file for STL in text form.
    return about.encode().ljust(80) + struct.pack("<I", len(corners)) + facets.tobytes()


def _normals(corners: NDArray) -> NDArray:
    """(F, 3) normals of triangles (F, 3, 3), twice as long as their area."""
    return np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])


# A grid mesh of one depth.


def depth_grid(surface: Surface, step: int, max_slope: float) -> Mesh:
    """A grid mesh with a vertex at every `step`-th pixel that shows a surface, cut at jumps of depth.

    A triangle is kept if along none of its edges depth changes by more than `max_slope` times the distance between the
    pixels at the nearer depth. World axes, mm.
    """
    depth = surface.depth[::step, ::step].astype(np.float64)
    pixels = pixel_centers(surface.camera.width, surface.camera.height)[::step, ::step]
    numbers = np.arange(depth.size, dtype=np.int32).reshape(depth.shape)
    a, b, c, d = numbers[:-1, :-1], numbers[:-1, 1:], numbers[1:, :-1], numbers[1:, 1:]
    triangles = np.concatenate([np.stack([a, c, b], -1).reshape(-1, 3), np.stack([b, c, d], -1).reshape(-1, 3)])
    triangles = triangles[_is_continuous(depth.ravel(), pixels.reshape(-1, 2), triangles, surface.camera.fx, max_slope)]
    used, triangles = split_at_touching_corners(triangles)
    vertices = back_project(pixels.reshape(-1, 2)[used].astype(np.float64), depth.ravel()[used], surface.camera)
    colors = surface.color[::step, ::step].reshape(-1, 3)[used]
    return Mesh(vertices.astype(np.float32), triangles, np.rint(colors * 255).astype(np.uint8))


def split_at_touching_corners(triangles: NDArray[np.int32]) -> tuple[NDArray[np.intp], NDArray[np.int32]]:
    """A vertex of its own for each fan of triangles: fans that touch in a corner alone are no surface there.

    Args:
        triangles: (F, 3) vertex numbers; no edge has more than two triangles.
    Returns:
        (V,) old number of each new vertex, ascending, and (F, 3) the triangles in new numbers.
    """
    corners = np.arange(triangles.size).reshape(-1, 3)
    # Both ends of each edge: their vertex numbers, the smaller one first, and their corners in the same order.
    vertices, ends = (np.stack([each, np.roll(each, -1, 1)], -1).reshape(-1, 2) for each in (triangles, corners))
    flip = np.argsort(vertices, 1, kind="stable")
    vertices, ends = np.take_along_axis(vertices, flip, 1), np.take_along_axis(ends, flip, 1)
    order = np.lexsort(vertices.T[::-1])
    shared = (vertices[order[1:]] == vertices[order[:-1]]).all(1)
    one, other = ends[order[:-1]][shared].ravel(), ends[order[1:]][shared].ravel()
    links = coo_array((np.ones(len(one), bool), (one, other)), shape=(triangles.size, triangles.size))
    _, fan = connected_components(links, directed=False)
    pairs, renumbered = np.unique(np.stack([triangles.ravel(), fan], 1), axis=0, return_inverse=True)
    return pairs[:, 0].astype(np.intp), renumbered.reshape(-1, 3).astype(np.int32)


def _is_continuous(
    depth: NDArray, pixels: NDArray, triangles: NDArray, focal: float, max_slope: float
) -> NDArray[np.bool_]:
    """(F,) whether all corners show a surface and no edge is a jump."""
    z, at = depth[triangles], pixels[triangles]
    before_z, before_at = np.roll(z, 1, 1), np.roll(at, 1, 1)
    near = np.minimum(z, before_z)
    sideways = near / focal * np.linalg.norm(at - before_at, axis=2)
    return ((near > 0) & (np.abs(z - before_z) <= max_slope * sideways)).all(1)


# The depths of several cameras fused.

TRUNCATION_VOXELS = 3.0
"""Distances to a surface are truncated at so many voxels, before and behind it."""
MAX_VIEWS = 24
MAX_VOXELS = 20_000_000
# Six tetrahedra around the diagonal from corner 0 to corner 7; bits of a corner's number are its steps along x, y, z.
_TETRAHEDRA = ((0, 1, 3, 7), (0, 3, 2, 7), (0, 2, 6, 7), (0, 6, 4, 7), (0, 4, 5, 7), (0, 5, 1, 7))
_CORNERS = np.array([[n & 1, n >> 1 & 1, n >> 2 & 1] for n in range(8)])
# For so many corners inside, which come first, the edges that are cut: three for each triangle.
_CUTS = (
    (1, ((0, 1), (0, 2), (0, 3))),
    (2, ((0, 2), (0, 3), (1, 3))),
    (2, ((0, 2), (1, 3), (1, 2))),
    (3, ((3, 0), (3, 1), (3, 2))),
)


def viewpoints(cameras: tuple[Camera, ...]) -> list[Camera]:
    """Cameras at different places, evenly chosen, `MAX_VIEWS` at most.

    Raises:
        InputError: the camera never moves.
    """
    kept: dict[bytes, Camera] = {}
    for camera in cameras:
        kept.setdefault(np.round(camera.world_to_camera, 4).tobytes(), camera)
    different = list(kept.values())
    if len(different) < 2:
        raise input_error("--mesh-method tsdf", "several camera positions", "one", "use --mesh-method grid.")
    return [different[i] for i in evenly_spaced(len(different), MAX_VIEWS)]


def fused_mesh(views: list[Surface], voxel_mm: float) -> Mesh:
    """The surface of several views in world axes, mm: a truncated signed distance on a grid is zero there.

    Args:
        voxel_mm: edge of a voxel, mm.
    Raises:
        InputError: the grid would be larger than `MAX_VOXELS`, or no view shows a surface.
    """
    low, shape = _grid(views, voxel_mm)
    distance, weight = np.zeros((2, *shape), np.float32)
    color = np.zeros((*shape, 3), np.float32)
    for x in range(shape[0]):  # a slice at a time, so that memory stays small
        points = low + voxel_mm * np.stack(np.broadcast_arrays(x, *np.ogrid[: shape[1], : shape[2]]), -1)
        for surface in views:
            _add(surface, points, TRUNCATION_VOXELS * voxel_mm, distance[x], weight[x], color[x])
    share = np.maximum(weight, 1)
    vertices, triangles, colors = _zero_surface(distance / share, weight > 0, color / share[..., None])
    colors = np.rint(colors.clip(0, 1) * 255).astype(np.uint8)
    return Mesh((low + voxel_mm * vertices).astype(np.float32), triangles.astype(np.int32), colors)


def _grid(views: list[Surface], voxel_mm: float) -> tuple[NDArray[np.float64], tuple[int, int, int]]:
    """First corner (3,), mm, and number of voxels of a grid with a margin around every visible point."""
    points = []
    for surface in views:
        pixels, seen = pixel_centers(surface.camera.width, surface.camera.height), surface.depth > 0
        points.append(back_project(pixels[seen], surface.depth[seen], surface.camera))
    visible = np.concatenate(points)
    if not len(visible):
        raise input_error("--min-alpha", "a value that leaves a surface", "one too high", "lower it.")
    margin = (TRUNCATION_VOXELS + 1) * voxel_mm
    low = visible.min(0) - margin
    nx, ny, nz = (int(n) for n in np.ceil((visible.max(0) + margin - low) / voxel_mm) + 1)
    if nx * ny * nz > MAX_VOXELS:
        least = voxel_mm * (nx * ny * nz / MAX_VOXELS) ** (1 / 3)
        raise input_error("--voxel-mm", f"at least {least:.2f} for a scene of this size", f"{voxel_mm}", "raise it.")
    return low, (nx, ny, nz)


def _add(
    surface: Surface, points: NDArray, truncation: float, distance: NDArray, weight: NDArray, color: NDArray
) -> None:
    """Add the distance, weight and color of points (..., 3) in one view to their sums."""
    pixels, z = project(points, surface.camera)
    column, row = np.moveaxis(np.floor(pixels), -1, 0)
    inside = (z > 0) & (column >= 0) & (row >= 0) & (column < surface.camera.width) & (row < surface.camera.height)
    row, column = np.where(inside, row, 0).astype(np.intp), np.where(inside, column, 0).astype(np.intp)
    depth = surface.depth[row, column]
    before = depth - z  # positive in front of the surface
    known = inside & (depth > 0) & (before > -truncation)
    distance += np.where(known, np.minimum(before, truncation), 0)
    weight += known
    color += np.where(known[..., None], surface.color[row, column], 0)


def _zero_surface(field: NDArray, known: NDArray[np.bool_], color: NDArray) -> tuple[NDArray, NDArray, NDArray]:
    """Vertices (V, 3) in voxels, triangles (F, 3) and colors of the zero level within cubes known at every corner."""
    to_corners, values = _CORNERS @ [field.shape[1] * field.shape[2], field.shape[2], 1], field.ravel()
    # Of each grid point, the cube of which it is the first corner.
    crossed = minimum_filter(known.astype(np.uint8), 2, origin=-1) > 0
    crossed &= (minimum_filter(field, 2, origin=-1) < 0) & (maximum_filter(field, 2, origin=-1) >= 0)
    crossed[-1], crossed[:, -1], crossed[:, :, -1] = False, False, False
    cubes = np.flatnonzero(crossed)[:, None] + to_corners
    edges = np.concatenate([_triangles_of(cubes[:, corners], values) for corners in _TETRAHEDRA])
    keys, renumbered = np.unique(np.sort(edges, -1).reshape(-1, 2) @ [field.size, 1], return_inverse=True)
    ends = np.stack(np.divmod(keys, field.size))  # of each vertex: the two grid points between which it lies
    low, high = values[ends]
    share = (low / (low - high)).astype(np.float64)[:, None]
    lower, upper = _places(ends, field.shape)
    vertices = lower * (1 - share) + upper * share
    triangles = renumbered.reshape(-1, 3)
    # Normals must point to where the field is positive, outside: from the inner to the outer ends of the edges.
    outwards = (_places(edges, field.shape) * np.where(values[edges] < 0, -1, 1)[..., None]).sum((1, 2))
    wrong = (_normals(vertices[triangles]) * outwards).sum(1) < 0
    triangles[wrong] = triangles[wrong][:, ::-1]
    first_color, second_color = color.reshape(-1, 3)[ends]
    return vertices, triangles, first_color * (1 - share) + second_color * share


def _places(numbers: NDArray[np.intp], shape: tuple[int, ...]) -> NDArray[np.intp]:
    """(..., 3) grid coordinates of numbered grid points."""
    return np.stack(np.unravel_index(numbers, shape), -1)


def _triangles_of(corners: NDArray[np.intp], values: NDArray) -> NDArray[np.intp]:
    """(F, 3, 2) edges, as pairs of grid points, that the surface's triangles cut in tetrahedra with corners (M, 4)."""
    order = np.argsort(values[corners] >= 0, axis=1, kind="stable")  # those inside come first
    corners = np.take_along_axis(corners, order, 1)
    num_inside = (values[corners] < 0).sum(1)
    return np.concatenate([corners[num_inside == count][:, cut] for count, cut in _CUTS])


FORMAT = ExportFormat(
    suffixes=(".ply", ".obj", ".stl"),
    options=(*TIME_STEP_OPTIONS, "mesh_format", *SURFACE_OPTIONS),
    files=files,
    suffix_option="mesh_format",
    holds="a mesh",
)
