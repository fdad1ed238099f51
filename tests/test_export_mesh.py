"""Meshes: the geometry of known depth in mm, holes where there is no surface, and files that trimesh reads."""

from __future__ import annotations

import io

import numpy as np
import pytest
import trimesh
from export_scenes import moving_scene, plane_camera

from endoprior.core.checks import InputError
from endoprior.core.types import Camera
from endoprior.export.axes import points_in_axes
from endoprior.export.mesh import Mesh, depth_grid, encode_mesh, fused_mesh, split_at_touching_corners, viewpoints
from endoprior.model.surface import Surface, render_surface

CENTER, RADIUS = np.array([1.0, -2.0, 70.0]), 20.0


def rays(camera: Camera) -> tuple[np.ndarray, np.ndarray]:
    """Camera center (3,) and directions (H, W, 3) with z = 1, world axes; the camera looks along z."""
    x = (np.arange(camera.width) + 0.5 - camera.cx) / camera.fx
    y = (np.arange(camera.height) + 0.5 - camera.cy) / camera.fy
    return camera.center, np.stack([*np.meshgrid(x, y), np.ones((camera.height, camera.width))], -1)


def sphere(camera: Camera, back: float | None = None) -> Surface:
    """What a camera sees of a ball, and of a wall at z = `back` behind it."""
    origin, d = rays(camera)
    b, c = d @ (origin - CENTER), ((origin - CENTER) ** 2).sum() - RADIUS**2
    inside = b**2 - (d**2).sum(-1) * c
    depth = np.where(inside > 0, (-b - np.sqrt(np.maximum(inside, 0))) / (d**2).sum(-1), back or 0.0)
    color = np.where((inside > 0)[..., None], [1.0, 0.5, 0.0], [0.0, 0.0, 1.0])
    return Surface(depth.astype(np.float32), color.astype(np.float32), camera)


def plane(camera: Camera, slope: float) -> Surface:
    """What a camera sees of the plane z = 60 + slope x, red growing to the right."""
    origin, d = rays(camera)
    depth = (60 + slope * origin[0]) / (1 - slope * d[..., 0])
    red = np.linspace(0, 1, camera.width)
    color = np.broadcast_to(np.stack([red, 0 * red, 0 * red], -1), (*depth.shape, 3))
    return Surface(depth.astype(np.float32), color.astype(np.float32), camera)


@pytest.mark.parametrize("step", [1, 3])
def test_grid_of_a_plane_is_flat_whole_and_faces_the_camera(step):
    camera = plane_camera(shift=5.0)
    mesh = depth_grid(plane(camera, 0.4), step, 5.0)
    rows, columns = -(-48 // step), -(-64 // step)
    assert len(mesh.vertices) == rows * columns and len(mesh.triangles) == 2 * (rows - 1) * (columns - 1)
    x, _y, z = mesh.vertices.T
    assert z == pytest.approx(60 + 0.4 * x, abs=1e-4)  # float32 of mm below 100
    normals = trimesh.Trimesh(mesh.vertices, mesh.triangles, process=False).face_normals
    want = np.array([0.4, 0, -1]) / np.hypot(0.4, 1)
    assert normals == pytest.approx(np.broadcast_to(want, normals.shape), abs=1e-3)
    d = np.array([(0.5 - 30) / 80, (0.5 - 26) / 80])
    z_there = (60 + 0.4 * 5) / (1 - 0.4 * d[0])
    assert mesh.vertices[0] == pytest.approx([5 + d[0] * z_there, d[1] * z_there, z_there], abs=1e-3)  # pixel (0, 0)


def test_grid_of_a_sphere_has_its_radius_and_is_torn_from_the_wall():
    seen = sphere(plane_camera(), back=120.0)
    for max_slope, torn in ((5.0, True), (1000.0, False)):
        mesh = depth_grid(seen, 1, max_slope)
        ball = np.abs(np.linalg.norm(mesh.vertices - CENTER, axis=1) - RADIUS) < 1e-3
        wall = np.abs(mesh.vertices[:, 2] - 120) < 1e-3
        assert (ball | wall).all() and ball.sum() > 300 and wall.sum() > 1000
        corners = ball[mesh.triangles]
        assert (corners.all(1) | ~corners.any(1)).all() == torn  # whether no triangle joins both
    assert (mesh.colors[ball] == [255, 128, 0]).all() and (mesh.colors[wall] == [0, 0, 255]).all()


def test_no_vertex_where_nothing_is_seen():
    seen = sphere(plane_camera())
    mesh = depth_grid(seen, 1, 5.0)
    assert np.linalg.norm(mesh.vertices - CENTER, axis=1) == pytest.approx(RADIUS, abs=1e-3)
    assert len(mesh.vertices) <= (seen.depth > 0).sum()
    assert set(mesh.triangles.ravel()) == set(range(len(mesh.vertices)))


def test_fusion_of_a_sphere_from_several_sides():
    views = [sphere(plane_camera(shift=shift), back=120.0) for shift in (-20.0, 0.0, 20.0)]
    fused = fused_mesh(views, 1.0)
    vertices, triangles, colors = fused.vertices, fused.triangles, fused.colors
    radius = np.linalg.norm(vertices - CENTER, axis=1)
    front = (radius < RADIUS + 3) & (vertices[:, 2] < 60)
    assert front.sum() > 500 and np.abs(radius[front] - RADIUS).mean() < 0.2  # a fifth of a voxel
    elsewhere = (np.abs(radius - RADIUS) > 2) & (np.abs(vertices[:, 2] - 120) > 2)
    assert elsewhere.mean() < 0.03  # nothing is made up behind the ball
    mesh = trimesh.Trimesh(vertices, triangles, process=False)
    faces = front[triangles].all(1)
    outwards = (mesh.face_normals[faces] * (mesh.triangles_center[faces] - CENTER)).sum(1)
    areas = mesh.area_faces[faces]
    assert (outwards > 0)[areas > 1e-3].all()
    assert (np.abs(colors[front].astype(int) - [255, 128, 0]).max(1) < 60).mean() > 0.9
    edges = np.sort(mesh.edges[np.repeat(faces, 3)], axis=1)
    assert np.unique(edges, axis=0, return_counts=True)[1].max() == 2  # a surface, not a soup


def test_fusion_wants_a_camera_that_moves():
    assert len(viewpoints(moving_scene(moving_camera=True).cameras)) == 10
    with pytest.raises(InputError, match="several camera positions"):
        viewpoints(moving_scene().cameras)
    with pytest.raises(InputError, match="voxel-mm"):
        fused_mesh([sphere(plane_camera(), 120.0)], 0.01)


def test_surface_is_freed_from_the_background():
    scene = moving_scene()
    out = scene.render(0.2)
    seen = render_surface(scene, 0.2, scene.cameras[2], 0.5)
    shown = out.alpha.numpy() >= 0.5
    assert shown.any() and not shown.all()
    assert (seen.depth[~shown] == 0).all() and (seen.color[~shown] == 0).all()
    expected = out.depth.numpy()[shown] / out.alpha.numpy()[shown]
    assert seen.depth[shown] == pytest.approx(expected, rel=1e-6)
    assert abs(np.median(seen.depth[shown]) - 60) < 5


@pytest.fixture
def triangle_mesh() -> Mesh:
    """Two triangles with corners and colors that are all different."""
    vertices = np.float32([[0, 0, 10], [4, 0, 11], [0, 3, 12], [5, 6, 13.5]])
    colors = np.uint8([[255, 0, 0], [0, 200, 0], [0, 0, 100], [9, 8, 7]])
    return Mesh(vertices, np.int32([[0, 2, 1], [1, 2, 3]]), colors)


@pytest.mark.parametrize("kind", ["ply", "obj", "stl"])
def test_mesh_files_read_back(kind, triangle_mesh):
    data = encode_mesh(triangle_mesh, kind, "ras")
    assert b"SPACE=RAS" in data[:200] and b"SPACE" not in encode_mesh(triangle_mesh, kind, "opengl")[:200]
    found = trimesh.load(io.BytesIO(data), file_type=kind, process=False)
    corners = points_in_axes(triangle_mesh.vertices, "ras")[triangle_mesh.triangles]
    assert found.triangles == pytest.approx(corners, abs=1e-5)
    if kind == "stl":
        assert len(data) == 84 + 50 * 2 and not data.startswith(b"solid")
        stored = np.frombuffer(data, np.dtype([("n", "<f4", 3), ("v", "<f4", (3, 3)), ("a", "<u2")]), offset=84)["n"]
        assert stored == pytest.approx(found.face_normals, abs=1e-6)
    else:
        assert (found.visual.vertex_colors[:, :3] == triangle_mesh.colors).all()
        assert (found.faces == triangle_mesh.triangles).all()


def fans(triangles, vertex):
    """How many groups of triangles around a vertex hang together by edges; a slow loop."""
    left = [set(map(int, triangle)) - {vertex} for triangle in triangles if vertex in triangle]
    count = 0
    while left:
        count, group = count + 1, left.pop()
        while joined := [other for other in left if other & group]:
            for other in joined:
                left.remove(other)
                group |= other
    return count


def test_triangles_that_touch_in_a_corner_get_a_vertex_each():
    bow_tie = np.array([[0, 1, 2], [2, 3, 4], [3, 5, 4]], np.int32)
    old, new = split_at_touching_corners(bow_tie)
    assert old.tolist() == [0, 1, 2, 2, 3, 4, 5] and (old[new] == bow_tie).all() and new.max() == 6
    whole = np.array([[0, 1, 2], [1, 3, 2]], np.int32)
    old, new = split_at_touching_corners(whole)
    assert old.tolist() == [0, 1, 2, 3] and (new == whole).all()
    assert split_at_touching_corners(np.zeros((0, 3), np.int32))[1].shape == (0, 3)


def test_no_vertex_of_a_grid_joins_two_surfaces():
    """Depth with random holes has many such corners."""
    camera = Camera(24, 20, 30.0, 30.0, 12.0, 10.0, np.eye(4))
    depth = np.where(np.random.default_rng(0).random((20, 24)) < 0.25, 0, 50).astype(np.float32)
    mesh = depth_grid(Surface(depth, np.zeros((20, 24, 3), np.float32), camera), 1, 5.0)
    assert all(fans(mesh.triangles, vertex) == 1 for vertex in range(len(mesh.vertices)))
    assert len(np.unique(mesh.vertices, axis=0)) < len(mesh.vertices)
