"""The moving exports in VTK, PyVista and trimesh: each opens the file, and has at several times what we wrote."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
import trimesh
from export_scenes import export, moving_run

from endoprior.core.types import frame_times
from endoprior.export.axes import points_in_axes
from endoprior.export.mesh import Mesh, depth_grid
from endoprior.model.carry import carry_points
from endoprior.model.scene_file import load_scene
from endoprior.model.surface import render_surface

NO_VTK = "MOVING MESHES ARE NOT OPENED IN VTK: `pip install vtk`"
NO_PYVISTA = "MOVING MESHES ARE NOT OPENED IN PYVISTA: `pip install pyvista`"
STEP = 3  # of the mesh, px


@pytest.fixture(scope="module")
def run(tmp_path_factory) -> Path:
    return moving_run(tmp_path_factory.mktemp("programs") / "run")


@pytest.fixture(scope="module")
def expected(run) -> tuple[Mesh, np.ndarray]:
    """The mesh of the first frame, and its (T, V, 3) vertices in all ten; world axes, mm."""
    scene = load_scene(run)
    mesh = depth_grid(render_surface(scene, 0.0, scene.cameras[0], 0.5), STEP, 5.0)
    times = frame_times(len(scene.cameras))
    return mesh, carry_points(scene, mesh.vertices, np.zeros(len(mesh.vertices), np.intp), times)


@pytest.fixture(scope="module")
def animation(run) -> Path:
    file = run.parent / "moving.glb"
    assert export(run, file, "animation", "--mesh-step", str(STEP)) == 0
    return file


@pytest.fixture(scope="module")
def measures(run) -> Path:
    folder = run.parent / "measures"
    assert export(run, folder, "measures", "--mesh-step", str(STEP)) == 0
    return folder


def test_vtk_plays_the_animation(animation, expected):
    """ParaView reads .glb with the same class."""
    vtk = pytest.importorskip("vtk", reason=NO_VTK)
    from vtk.util.numpy_support import vtk_to_numpy  # pyright: ignore[reportMissingImports]

    reader = vtk.vtkGLTFReader()
    reader.SetFileName(str(animation))
    reader.SetFrameRate(25)
    reader.UpdateInformation()
    assert reader.GetNumberOfAnimations() == 1 and reader.GetAnimationDuration(0) == pytest.approx(9 / 25)
    reader.EnableAnimation(0)
    mesh, carried = expected
    for frame in (0, 4, 9):
        reader.UpdateTimeStep(frame / 25)
        blocks = reader.GetOutput().NewIterator()
        blocks.InitTraversal()
        found = blocks.GetCurrentDataObject()
        there = points_in_axes(carried[frame], "opengl")
        assert 1000 * vtk_to_numpy(found.GetPoints().GetData()) == pytest.approx(there, abs=1e-3)
        linear = vtk_to_numpy(found.GetPointData().GetArray("COLOR_0"))[:, :3]
        encoded = np.where(linear <= 0.0031308, 12.92 * linear, 1.055 * linear ** (1 / 2.4) - 0.055)
        assert 255 * encoded == pytest.approx(mesh.colors, abs=0.01)


def test_pyvista_plays_the_surface_with_its_values(measures, expected):
    """ParaView reads .pvd likewise."""
    pyvista = pytest.importorskip("pyvista", reason=NO_PYVISTA)
    reader = pyvista.get_reader(str(measures / "surface.pvd"))
    assert reader.time_values == pytest.approx([i / 25 for i in range(10)])
    mesh, carried = expected
    for frame in (0, 4, 9):
        reader.set_active_time_value(reader.time_values[frame])
        (found,) = reader.read()
        assert np.asarray(found.points) == pytest.approx(carried[frame], abs=1e-3)
        assert np.array_equal(found.regular_faces, mesh.triangles)
        moved = np.linalg.norm(carried[frame] - carried[0], axis=1)
        assert found["displacement"] == pytest.approx(moved, abs=1e-3)
    assert moved.max() > 0.1


def test_trimesh_opens_the_first_time_step_of_the_animation(animation, expected):
    """It knows no morph targets: a folder of meshes moves there."""
    found = trimesh.load(animation, force="mesh", process=False)
    mesh, carried = expected
    assert 1000 * found.vertices == pytest.approx(points_in_axes(carried[0], "opengl"), abs=1e-3)
    assert np.array_equal(found.faces, mesh.triangles)


def test_trimesh_shows_a_folder_of_meshes_move(run, tmp_path):
    assert export(run, tmp_path / "out", "mesh", "--mesh-step", str(STEP)) == 0
    files = sorted((tmp_path / "out").glob("*.ply"))
    assert len(files) == 10
    scene = load_scene(run)
    for frame in (0, 9):
        want = depth_grid(render_surface(scene, frame / 10, scene.cameras[frame], 0.5), STEP, 5.0)
        found = trimesh.load(files[frame], process=False)
        assert found.vertices == pytest.approx(want.vertices, abs=1e-4)
        assert np.array_equal(found.visual.vertex_colors[:, :3], want.colors)
