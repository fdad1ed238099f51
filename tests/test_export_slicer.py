"""`--format slicer`: a scene whose every reference leads somewhere, and whose meshes are those of `--format mesh`."""

from __future__ import annotations

import re
from dataclasses import replace

import numpy as np
import pytest
import trimesh
from export_scenes import moving_scene
from scipy.spatial.transform import Rotation
from slicer_reader import Bundle, sequence_index, vector

from endoprior.cli import main
from endoprior.export.axes import points_in_axes
from endoprior.model.scene_file import load_scene

TIMES = ("0.1", "0.2", "0.6")
SECONDS = (0.04, 0.08, 0.24)  # ten frames at 25 per second


@pytest.fixture(scope="module")
def run(tmp_path_factory):
    """A run folder with a scene whose Gaussians move and whose camera moves and rolls."""
    folder = tmp_path_factory.mktemp("slicer") / "run"
    scene = moving_scene(moving_camera=True)
    poses = [camera.world_to_camera.copy() for camera in scene.cameras]
    for i, pose in enumerate(poses):
        pose[:3] = Rotation.from_euler("z", 5 * i, degrees=True).as_matrix() @ pose[:3]
    cameras = tuple(replace(c, world_to_camera=pose) for c, pose in zip(scene.cameras, poses, strict=True))
    replace(scene, cameras=cameras).save(folder / "scene.safetensors")
    return folder


@pytest.fixture(scope="module")
def bundle(run, tmp_path_factory):
    """The exported scene, opened."""
    out = tmp_path_factory.mktemp("slicer") / "a scene.mrb"
    assert main(["export", str(run), str(out), "--format", "slicer", "--times", *TIMES, "--mesh-step", "3"]) == 0
    return Bundle(out.read_bytes())


@pytest.fixture(scope="module")
def meshes(run, tmp_path_factory):
    """What `--format mesh` writes of the same times, in RAS axes."""
    out = tmp_path_factory.mktemp("slicer") / "meshes"
    options = ("--times", *TIMES, "--mesh-step", "3", "--frame", "ras")
    assert main(["export", str(run), str(out), "--format", "mesh", *options]) == 0
    return [trimesh.load(file, process=False) for file in sorted(out.glob("*.ply"))]


def same(found: trimesh.Trimesh, want: trimesh.Trimesh) -> bool:
    """Whether two meshes agree in triangles, colors and positions, float32 of mm below 100."""
    return (
        np.array_equal(found.faces, want.faces)
        and np.array_equal(found.visual.vertex_colors, want.visual.vertex_colors)
        and np.allclose(found.vertices, want.vertices, atol=1e-5)
    )


def test_the_browser_plays_the_mesh_of_every_time(bundle, meshes):
    browser = bundle.only("SequenceBrowser")
    (postfix,) = browser.attributes["virtualNodePostfixes"].split()
    synchronization = browser.attributes[f"SynchronizationPropertiesMap{postfix}"].split()
    assert dict(zip(synchronization[::2], synchronization[1::2], strict=True))["playback"] == "true"
    assert float(browser.attributes["playbackRateFps"]) == pytest.approx(2 / 0.2)
    sequence = bundle.referenced(browser, f"sequenceNodeRef{postfix}", "Sequence")
    assert bundle.referenced(browser, f"dataNodeRef{postfix}", "Model") is bundle.only("Model")

    inside = Bundle(bundle.stored(sequence, "SequenceStorage"))
    embedded = inside.only("Sequence")
    assert embedded.attributes["singletonTag"] == "SequenceIndex"
    for node in (sequence, embedded):
        assert [node.attributes[f"index{x}"] for x in ("Name", "Unit", "Type")] == ["time", "s", "numeric"]
        assert 0 < float(node.attributes["numericIndexValueTolerance"]) < 0.02  # half the shortest step
        index = sequence_index(node)
        assert list(index) == pytest.approx(SECONDS)
        shown = [inside.model(inside.nodes[identity]) for identity in index.values()]
        assert all(same(found, want) for found, want in zip(shown, meshes, strict=True))
    assert not same(shown[0], shown[2])


def test_the_model_shows_the_first_mesh_in_the_colors_of_the_video(bundle, meshes):
    model = bundle.only("Model")
    assert same(bundle.model(model), meshes[0])
    display = bundle.referenced(model, "display", "ModelDisplay").attributes
    assert (display["scalarVisibility"], display["scalarRangeFlag"]) == ("true", "UseDirectMapping")
    assert (display["activeScalarName"], display["activeAttributeLocation"]) == ("RGB", "point")
    assert (display["ambient"], display["diffuse"]) == ("1", "0")


def test_the_view_looks_along_the_endoscope_and_shows_the_whole_mesh(run, bundle, meshes):
    camera = bundle.only("Camera")
    assert camera.attributes["singletonTag"] == "1"  # the camera of Slicer's first 3D view
    position, focus, up = (vector(camera, name) for name in ("position", "focalPoint", "viewUp"))
    towards = (focus - position) / np.linalg.norm(focus - position)
    right, down, forward = load_scene(run).cameras[1].world_to_camera[:3, :3]
    assert towards == pytest.approx(points_in_axes(forward, "ras"), abs=1e-5)
    assert up == pytest.approx(points_in_axes(-down, "ras"), abs=1e-5)
    assert towards == pytest.approx([0, -1, 0], abs=1e-5)  # from anterior to posterior
    rays = meshes[0].vertices - position
    angles = np.rad2deg(np.arctan2(rays @ np.stack([points_in_axes(right, "ras"), up]).T, (rays @ towards)[:, None]))
    assert 5 < np.abs(angles).max() <= 15  # Slicer's view is 30 degrees high
    assert np.sign(rays @ towards).min() == 1


def test_points_play_with_the_mesh_where_tracks_has_them(run, tmp_path):
    queries = tmp_path / "points.csv"
    queries.write_text("x,y,frame\n30.5,20.5,0\n28,25,4\n34,22,4\n")
    options = ("--points", str(queries))
    assert main(["export", str(run), str(tmp_path / "a.mrb"), "--split", "test", "--mesh-step", "8", *options]) == 0
    assert main(["export", str(run), str(tmp_path / "t"), "--format", "tracks", "--frame", "ras", *options]) == 0
    found = np.load(tmp_path / "t" / "tracks.npz")
    bundle = Bundle((tmp_path / "a.mrb").read_bytes())
    browser = bundle.only("SequenceBrowser")
    assert browser.attributes["virtualNodePostfixes"].split() == ["0", "1"]
    assert "playback true" in browser.attributes["SynchronizationPropertiesMap1"]
    assert bundle.referenced(browser, "dataNodeRef0", "Model") is bundle.only("Model")
    shown = bundle.referenced(browser, "dataNodeRef1", "MarkupsFiducial")
    bundle.referenced(shown, "display", "MarkupsDisplay")
    assert bundle.markups(shown)[0] == pytest.approx(found["points"][1], abs=1e-4)
    sequence = bundle.referenced(browser, "sequenceNodeRef1", "Sequence")
    assert sequence.attributes["attributes"] == "DataNodeClassName:vtkMRMLMarkupsFiducialNode"
    inside = Bundle(bundle.stored(sequence, "SequenceStorage"))
    index = sequence_index(inside.only("Sequence"))
    assert index == sequence_index(sequence) and list(index) == pytest.approx([1 / 25, 9 / 25])
    for frame, identity in zip((1, 9), index.values(), strict=True):
        positions, points = inside.markups(inside.nodes[identity])
        assert positions == pytest.approx(found["points"][frame], abs=1e-4)
        assert [p["label"] for p in points] == ["0", "1", "2"]
        numbers = [[float(n) for n in re.findall(r"[0-9.]+(?=[; ])", p["description"])] for p in points]
        wanted = np.stack([found[name][frame] for name in ("confidence", "across95", "along95")], 1)
        assert np.array(numbers) == pytest.approx(wanted, abs=0.02)


def test_vtk_reads_color_and_axes(bundle, meshes, tmp_path):
    vtk = pytest.importorskip("vtk", reason="THE MESHES ARE NOT READ BY VTK: `pip install vtk`")
    file = tmp_path / "model.ply"
    file.write_bytes(bundle.stored(bundle.only("Model"), "ModelStorage"))
    reader = vtk.vtkPLYReader()
    reader.SetFileName(str(file))
    reader.Update()
    comments = reader.GetComments()
    assert "SPACE=LPS" in [comments.GetValue(i) for i in range(comments.GetNumberOfValues())]
    scalars = reader.GetOutput().GetPointData().GetScalars()
    name = bundle.only("ModelDisplay").attributes["activeScalarName"]
    assert (scalars.GetName(), scalars.GetNumberOfComponents(), scalars.GetDataTypeAsString()) == (
        name,
        3,
        "unsigned char",
    )
    colors = np.array([scalars.GetTuple(i) for i in range(scalars.GetNumberOfTuples())])
    assert np.array_equal(colors, meshes[0].visual.vertex_colors[:, :3])


def test_every_frame_at_the_rate_of_the_sequence_and_equal_bytes(run, tmp_path):
    options = ("--format", "slicer", "--mesh-step", "8")
    for name in ("a.mrb", "b.mrb"):
        assert main(["export", str(run), str(tmp_path / name), *options]) == 0
    data = (tmp_path / "a.mrb").read_bytes()
    assert data == (tmp_path / "b.mrb").read_bytes()
    opened = Bundle(data)
    assert list(sequence_index(opened.only("Sequence"))) == pytest.approx([i / 25 for i in range(10)])
    assert float(opened.only("SequenceBrowser").attributes["playbackRateFps"]) == 25
