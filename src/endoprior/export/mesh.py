"""Surface meshes of one time step: a grid mesh of the rendered depth, or the depths of all cameras fused.

Triangles turn counterclockwise as seen from the camera, so normals point at it. `V` vertices, `F` triangles.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.sparse import coo_array
from scipy.sparse.csgraph import connected_components

from ..core.checks import input_error
from ..core.geometry import back_project, length_unit, pixel_centers
from ..model.scene import Scene
from ..model.surface import Surface, render_surface
from .axes import points_in_axes
from .formats import TIME_STEP_OPTIONS, Format
from .mesh_files import encode_mesh
from .options import ExportOptions
from .time_steps import TimeStep
from .tsdf import fused_mesh, viewpoints

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
    mesh = surface_mesh(scene, step, options)
    vertices = points_in_axes(mesh.vertices, options.frame)
    unit = length_unit(scene.lengths_are_relative)
    content = encode_mesh(vertices, mesh.triangles, mesh.colors, options.mesh_format, options.frame, unit)
    return {f".{options.mesh_format}": content}


def surface_mesh(scene: Scene, step: TimeStep, options: ExportOptions) -> Mesh:
    """The tissue surface at one time, by the method of the options; world axes, mm.

    Raises:
        InputError: no surface is rendered, or a fusion has fewer than two camera positions.
    """
    if options.mesh_method == "tsdf":
        shown = scene.shown_at(step.time)  # cameras of other windows look elsewhere
        cameras = scene.cameras[shown[0].window.start : shown[-1].window.stop]
        views = [render_surface(scene, step.time, c, options.min_alpha) for c in viewpoints(cameras)]
        mesh = Mesh(*fused_mesh(views, options.voxel_mm))
    else:
        surface = render_surface(scene, step.time, step.camera(scene), options.min_alpha)
        mesh = depth_grid(surface, options.mesh_step, options.max_slope)
    if not len(mesh.triangles):
        want = f"a value that leaves a surface at time {step.time:.3f}"
        raise input_error("--min-alpha", want, f"{options.min_alpha}", "lower it, or raise --max-slope.")
    return mesh


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
    return Mesh(
        vertices.astype(np.float32),
        triangles,
        np.rint(colors * 255).astype(np.uint8),
    )


def split_at_touching_corners(triangles: NDArray[np.int32]) -> tuple[NDArray[np.intp], NDArray[np.int32]]:
    """A vertex of its own for each fan of triangles: fans that touch in a corner alone are no surface there.

    Args:
        triangles: (F, 3) vertex numbers; no edge has more than two triangles.
    Returns:
        (V,) old number of each new vertex, ascending, and (F, 3) the triangles in new numbers.
    """
    if not len(triangles):
        return np.zeros(0, np.intp), triangles.astype(np.int32)
    corners = np.arange(triangles.size).reshape(-1, 3)
    starts, ends = triangles.ravel(), np.roll(triangles, -1, 1).ravel()
    # Of each edge, the corners at its smaller and its larger vertex number.
    here, there = corners.ravel(), np.roll(corners, -1, 1).ravel()
    smaller, larger = np.where(starts < ends, (here, there), (there, here))
    order = np.lexsort((np.maximum(starts, ends), np.minimum(starts, ends)))
    low, high = np.minimum(starts, ends)[order], np.maximum(starts, ends)[order]
    shared = np.flatnonzero((low[1:] == low[:-1]) & (high[1:] == high[:-1]))
    one = np.concatenate([smaller[order][shared], larger[order][shared]])
    other = np.concatenate([smaller[order][shared + 1], larger[order][shared + 1]])
    links = coo_array((np.ones(len(one), bool), (one, other)), shape=(triangles.size, triangles.size))
    _, fan = connected_components(links, directed=False)
    pairs, renumbered = np.unique(np.stack([starts, fan], 1), axis=0, return_inverse=True)
    return pairs[:, 0].astype(np.intp), renumbered.reshape(-1, 3).astype(np.int32)


def _is_continuous(
    depth: NDArray, pixels: NDArray, triangles: NDArray, focal: float, max_slope: float
) -> NDArray[np.bool_]:
    """(F,) whether all corners show a surface and no edge is a jump."""
    continuous = np.ones(len(triangles), bool)
    for k in range(3):
        one, other = triangles[:, k], triangles[:, k - 1]
        near = np.minimum(depth[one], depth[other])
        sideways = near / focal * np.linalg.norm(pixels[one] - pixels[other], axis=1)
        continuous &= (near > 0) & (np.abs(depth[one] - depth[other]) <= max_slope * sideways)
    return continuous


FORMAT = Format(
    suffixes=(".ply", ".obj", ".stl"),
    options=(*TIME_STEP_OPTIONS, "mesh_format", *SURFACE_OPTIONS),
    files=files,
    suffix_option="mesh_format",
    holds="a mesh",
)
