"""Fusing the depths of several cameras: a truncated signed distance on a grid, and the surface where it is zero.

Curless and Levoy, "A volumetric method for building complex models from range images", SIGGRAPH 1996. The surface is
extracted from tetrahedra, six to a cube, which leave no ambiguous case (Doi and Koide, 1991).
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from ..core.checks import input_error
from ..core.geometry import back_project, pixel_centers, project
from ..core.types import Camera
from ..model.surface import Surface

TRUNCATION_VOXELS = 3.0
"""Distances to a surface are truncated at so many voxels, before and behind it."""
MAX_VIEWS = 24
MAX_VOXELS = 20_000_000
# Six tetrahedra around the diagonal from corner 0 to corner 7; bits of a corner's number are its steps along x, y, z.
_TETRAHEDRA = ((0, 1, 3, 7), (0, 3, 2, 7), (0, 2, 6, 7), (0, 6, 4, 7), (0, 4, 5, 7), (0, 5, 1, 7))
_CORNERS = np.array([[n & 1, n >> 1 & 1, n >> 2 & 1] for n in range(8)])


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
    return [different[i] for i in np.unique(np.linspace(0, len(different) - 1, MAX_VIEWS).round().astype(int))]


def fused_mesh(
    views: list[Surface], voxel_mm: float
) -> tuple[NDArray[np.float32], NDArray[np.int32], NDArray[np.uint8]]:
    """Vertices (V, 3) mm in world axes, triangles (F, 3) with normals towards the cameras, and colors (V, 3).

    Args:
        voxel_mm: edge of a voxel, mm.
    Raises:
        InputError: the grid would be larger than `MAX_VOXELS`, or no view shows a surface.
    """
    low, shape = _grid(views, voxel_mm)
    distance, weight, color = (
        np.zeros(shape, np.float32),
        np.zeros(shape, np.float32),
        np.zeros((*shape, 3), np.float32),
    )
    plane = np.stack(np.meshgrid(*(np.arange(n) for n in shape[1:]), indexing="ij"), -1)
    for x in range(shape[0]):  # a slice at a time, so that memory stays small
        points = low + voxel_mm * np.concatenate([np.full((*shape[1:], 1), x), plane], -1)
        for surface in views:
            _add(surface, points, TRUNCATION_VOXELS * voxel_mm, distance[x], weight[x], color[x])
    share = np.maximum(weight, 1)
    vertices, triangles, colors = _zero_surface(distance / share, weight > 0, color / share[..., None])
    return (
        (low + voxel_mm * vertices).astype(np.float32),
        triangles.astype(np.int32),
        np.rint(colors.clip(0, 1) * 255).astype(np.uint8),
    )


def _grid(views: list[Surface], voxel_mm: float) -> tuple[NDArray[np.float64], tuple[int, int, int]]:
    """First corner (3,), mm, and number of voxels of a grid with a margin around every visible point."""
    points = [
        back_project(pixel_centers(surface.camera.width, surface.camera.height)[surface.depth > 0], z, surface.camera)
        for surface in views
        if len(z := surface.depth[surface.depth > 0])
    ]
    if not points:
        raise input_error("--min-alpha", "a value that leaves a surface", "one too high", "lower it.")
    visible = np.concatenate(points)
    margin = (TRUNCATION_VOXELS + 1) * voxel_mm
    low = visible.min(0) - margin
    shape = tuple(int(n) for n in np.ceil((visible.max(0) + margin - low) / voxel_mm) + 1)
    if np.prod(shape, dtype=np.float64) > MAX_VOXELS:
        least = voxel_mm * (np.prod(shape, dtype=np.float64) / MAX_VOXELS) ** (1 / 3)
        raise input_error("--voxel-mm", f"at least {least:.2f} for a scene of this size", f"{voxel_mm}", "raise it.")
    return low, shape


def _add(
    surface: Surface, points: NDArray, truncation: float, distance: NDArray, weight: NDArray, color: NDArray
) -> None:
    """Add the distance, weight and color of points (..., 3) in one view to their sums."""
    pixels, z = project(points, surface.camera)
    column, row = np.floor(pixels[..., 0]), np.floor(pixels[..., 1])
    inside = (z > 0) & (column >= 0) & (row >= 0) & (column < surface.camera.width) & (row < surface.camera.height)
    row, column = np.where(inside, row, 0).astype(np.intp), np.where(inside, column, 0).astype(np.intp)
    depth = surface.depth[row, column]
    before = depth - z  # positive in front of the surface
    known = inside & (depth > 0) & (before > -truncation)
    distance += np.where(known, np.minimum(before, truncation), 0)
    weight += known
    color += np.where(known[..., None], surface.color[row, column], 0)


def _zero_surface(
    field: NDArray[np.float32], known: NDArray[np.bool_], color: NDArray[np.float32]
) -> tuple[NDArray, NDArray, NDArray]:
    """Vertices (V, 3) in voxels, triangles (F, 3) and colors of the zero level within cubes known at every corner."""
    offsets = _CORNERS @ np.array([field.shape[1] * field.shape[2], field.shape[2], 1])
    cells = tuple(slice(0, n - 1) for n in field.shape)
    inside = np.stack([field[_shifted(field.shape, c)] < 0 for c in _CORNERS])
    whole = np.logical_and.reduce([known[_shifted(known.shape, c)] for c in _CORNERS])
    crossed = whole & inside.any(0) & ~inside.all(0)
    numbers = np.arange(field.size).reshape(field.shape)[cells][crossed]
    values = field.ravel()
    cut = [_triangles_of(numbers[:, None] + offsets[list(corners)], values) for corners in _TETRAHEDRA]
    edges = np.concatenate(cut)  # (F, 3, 2): each vertex lies between two grid points
    keys, renumbered = np.unique(np.sort(edges, -1).reshape(-1, 2) @ [field.size, 1], return_inverse=True)
    lower, upper = keys // field.size, keys % field.size
    share = (values[lower] / (values[lower] - values[upper])).astype(np.float64)[:, None]
    vertices = _places(lower, field.shape) * (1 - share) + _places(upper, field.shape) * share
    triangles = renumbered.reshape(-1, 3)
    # Normals must point to where the field is positive, outside: from the inner to the outer ends of the edges.
    outwards = (_places(edges, field.shape) * np.where(values[edges] < 0, -1, 1)[..., None]).sum((1, 2))
    corners = vertices[triangles]
    normal = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
    wrong = (normal * outwards).sum(1) < 0
    triangles[wrong] = triangles[wrong][:, ::-1]
    flat = color.reshape(-1, 3)
    return vertices, triangles, flat[lower] * (1 - share) + flat[upper] * share


def _places(numbers: NDArray[np.intp], shape: tuple[int, ...]) -> NDArray[np.intp]:
    """(..., 3) grid coordinates of numbered grid points."""
    return np.stack(np.unravel_index(numbers, shape), -1)


def _shifted(shape: tuple[int, ...], corner: NDArray) -> tuple[slice, ...]:
    """Of all cubes of a grid, the grid points at one corner."""
    return tuple(slice(int(step), size - 1 + int(step)) for step, size in zip(corner, shape, strict=True))


def _triangles_of(corners: NDArray[np.intp], values: NDArray[np.float32]) -> NDArray[np.intp]:
    """(F, 3, 2) edges, as pairs of grid points, that the surface's triangles cut in tetrahedra with corners (M, 4)."""
    order = np.argsort(values[corners] >= 0, axis=1, kind="stable")  # those inside come first
    corners = np.take_along_axis(corners, order, 1)
    num_inside = (values[corners] < 0).sum(1)
    a, b, c, d = corners.T
    cut = []
    for count, triangles in {
        1: [((a, b), (a, c), (a, d))],
        2: [((a, c), (a, d), (b, d)), ((a, c), (b, d), (b, c))],
        3: [((d, a), (d, b), (d, c))],
    }.items():
        rows = num_inside == count
        cut += [np.stack([np.stack([p[rows], q[rows]], -1) for p, q in edges], 1) for edges in triangles]
    return np.concatenate(cut)
