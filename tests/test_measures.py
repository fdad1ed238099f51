"""Measures over time: closed forms first, then a scene whose motion is known, then the files."""

import base64
import csv
from dataclasses import replace
from xml.etree import ElementTree

import cv2
import numpy as np
import pytest
import torch
from export_scenes import plane_camera
from plyfile import PlyData

from endoprior.cli import main
from endoprior.initialization.first_gaussians import create_gaussians
from endoprior.model.measures import (
    SurfaceMotion,
    area,
    distance,
    fitted_strain,
    measures_of,
    neighborhoods,
    path_length,
    polygon_triangles,
    smoothed,
)
from endoprior.model.presets import preset
from endoprior.model.scene import Scene, SingleScene
from endoprior.visualization.measures import displacement_span, measures_csv, stretch_span, value_colors


def turned(points: np.ndarray, seed: int = 0) -> np.ndarray:
    """Points (..., 3) after some rotation and translation."""
    axes, _ = np.linalg.qr(np.random.default_rng(seed).normal(size=(3, 3)))
    axes[:, 0] *= np.linalg.det(axes)
    return points @ axes.T + [3.0, -2.0, 50.0]


def patch(curved: bool) -> np.ndarray:
    """(12, 3) points anywhere on a plane or on a bowl."""
    x, y = np.random.default_rng(1).uniform(-2, 2, (2, 12))
    return np.stack([x, y, 0.2 * x * x + 0.1 * x * y if curved else 0 * x], -1)


def test_distance_and_path_of_a_uniform_motion():
    paths = np.arange(8)[:, None, None] * np.array([[3.0, 4, 0], [0, 0, 0]])
    assert distance(paths[:, 0], paths[:, 1]) == pytest.approx(5 * np.arange(8))
    assert path_length(paths)[:, 0] == pytest.approx(5 * np.arange(8)) and not path_length(paths)[:, 1].any()
    assert smoothed(paths) == pytest.approx(paths)  # constant velocity stays, at the ends too
    assert path_length(paths[:1]).tolist() == [[0, 0]]


def test_jitter_adds_path_length_and_smoothing_takes_most_of_it_away():
    jitter = np.random.default_rng(0).normal(size=(400, 50, 3))
    raw, smooth = path_length(jitter)[-1].mean() / 399, path_length(smoothed(jitter))[-1].mean() / 399
    assert raw == pytest.approx(4 / np.sqrt(np.pi), rel=0.02)  # the mean length of a normal vector of variance 2
    assert smooth < 0.3 * raw


@pytest.mark.parametrize(
    ("corners", "expected"),
    [
        ([(0, 0), (4, 0), (0, 3)], 6),
        ([(0, 0), (4, 0), (4, 2), (0, 2)], 8),
        ([(0, 0), (0, 2), (4, 2), (4, 0)], 8),  # clockwise
        ([(0, 0), (4, 0), (4, 4), (2, 1), (0, 4)], 10),  # a notch
        ([(0, 0), (6, 0), (6, 3), (5, 3), (5, 1), (1, 1), (1, 3), (0, 3)], 10),  # a U
    ],
)
def test_area_of_a_polygon_however_it_lies(corners, expected):
    flat = turned(np.column_stack([np.array(corners, float), np.zeros(len(corners))]))
    triangles = polygon_triangles(flat)
    assert len(triangles) == len(corners) - 2
    assert area(np.stack([flat, 2 * flat]), triangles) == pytest.approx([expected, 4 * expected])


@pytest.mark.parametrize(
    "corners",
    [[(0, 0), (1, 0)], [(0, 0), (1, 1), (2, 2)], [(0, 0), (4, 2), (4, 0), (0, 3)], [(0, 0), (1, np.nan), (1, 1)]],
)
def test_corners_that_surround_nothing_have_no_triangles(corners):
    assert not len(polygon_triangles(np.column_stack([np.array(corners, float), np.zeros(len(corners))])))


@pytest.mark.parametrize("curved", [False, True])
def test_a_rigid_motion_does_not_stretch_and_a_uniform_scaling_stretches_by_its_factor(curved):
    before = turned(patch(curved), 2)
    assert fitted_strain(before, turned(before, 3)).stretch == pytest.approx([1, 1])
    assert fitted_strain(before, turned(1.2 * before, 3)).stretch == pytest.approx([1.2, 1.2])


def test_stretch_along_one_direction_leaves_the_other():
    before, after = patch(False), patch(False) * [1.3, 1, 1]
    assert fitted_strain(turned(before, 2), turned(after, 3)).stretch == pytest.approx([1.3, 1])
    shear = patch(False) @ np.array(
        [[1, 0, 0], [0.5, 1, 0], [0, 0, 1.0]]
    )  # x + y / 2: singular values of [[1, .5], [0, 1]]
    assert fitted_strain(before, shear).stretch == pytest.approx(np.linalg.svd([[1, 0.5], [0, 1]])[1])


def test_stretch_of_what_is_unknown_or_thin_is_unknown():
    known = patch(True)
    broken, line = known.copy(), known * [1, 0, 0]
    broken[3, 1] = np.nan
    found = fitted_strain(np.stack([known, broken, known, line]), np.stack([known, known, broken, line])).stretch
    assert np.isfinite(found[0]).all() and np.isnan(found[1:]).all()


def test_neighbors_lie_around_a_point_or_it_is_beyond_the_surface():
    x, y = (part.ravel() for part in np.meshgrid(np.arange(20.0), np.arange(20.0)))
    samples = np.stack([x, y, 0 * x], -1)
    nearest, around = neighborhoods(np.array([[10.0, 10, 0.1], [0, 0, 0], [10, -4, 0], [10, 10, 9]]), samples)
    assert samples[nearest[0, 0]].tolist() == [10, 10, 0] and nearest.shape == (4, 24)
    assert around.tolist() == [True, True, False, False]  # a corner still is part of the surface


def test_measures_of_three_points():
    start = np.array([[0.0, 0, 50], [4, 0, 50], [0, 3, 50]])
    paths = start + np.array([0.0, 1, 2, 3, 4])[:, None, None] * [0, 0, 2.0]
    found = measures_of(paths, np.ones((5, 3)), since=1, drawn=2)
    assert found.distance == pytest.approx([4] * 5) and found.area == pytest.approx([6] * 5)
    assert found.path_length[:, 2] == pytest.approx([0, 2, 4, 6, 8]) == found.path_length_raw[:, 0].tolist()
    assert found.displacement[:, 1].tolist() == [2, 0, 2, 4, 6]
    alone = measures_of(paths[:, :1], np.ones((5, 1)), 0, 0)
    assert np.isnan(alone.distance).all() and np.isnan(alone.area).all()


def growing_scene(by: float) -> Scene:
    """A wall of Gaussians at 50 mm that grows by this factor over ten frames, seen from the front."""
    cfg = preset("default").fitted(20)
    x, y = (part.ravel() for part in np.meshgrid(np.linspace(-24, 24, 49), np.linspace(-18, 18, 37)))
    points = np.column_stack([x, y, np.full(x.size, 50.0)]).astype(np.float32)
    gaussians = create_gaussians(
        points, np.full((len(points), 3), 0.5, np.float32), np.zeros(len(points), np.float32), cfg
    )
    with torch.no_grad():
        gaussians["opacity_logits"].fill_(4.0)
        share = torch.linspace(0, 1, gaussians["motion"].shape[1])
        gaussians["motion"][:, :, 0] = torch.from_numpy(points[:, :1]) * share * (by - 1)
    return SingleScene(
        gaussians, None, cfg, (plane_camera(),) * 10, 25.0, torch.zeros(len(points)), torch.zeros(len(points))
    )


@pytest.fixture(scope="module")
def growing() -> Scene:
    """It grows along x alone, so one principal stretch is 1."""
    return growing_scene(1.3)


def along_x(scene: Scene, since: int, until: int) -> float:
    """How much the wall is longer along x than before."""
    middle = (scene.gaussians["means"][:, 0].abs() - 10).abs() < 0.1
    before, after = (scene.at(frame / 10).means[middle, 0].abs().mean() for frame in (since, until))
    return float(after / before)


def test_stretch_of_a_scene_is_that_of_its_gaussians(growing):
    motion = SurfaceMotion(growing, 2)
    points = np.array([[0.0, 0, 50], [8, -5, 50], [8, -5, 70], [np.nan, 0, 50]])
    found = motion.stretch(points, [2, 5, 9])
    expected = np.array([along_x(growing, 2, i) for i in (2, 5, 9)])
    assert np.median(motion.stretch(motion.samples, [2, 5, 9]), 1) == pytest.approx(expected, abs=0.01)
    # The eight Gaussians around a point change in steps, which a fit over a few of them shows.
    assert found[:, :2] == pytest.approx(np.stack([expected] * 2, 1), abs=0.04)
    assert found[2, 0] > 1.1 and np.isnan(found[:, 2:]).all()  # not on the surface; unknown


def test_strain_of_a_scene_has_direction_and_area(growing):
    points = np.array([[0.0, 0, 50], [8, -5, 50], [8, -5, 70]])
    strain, longer = SurfaceMotion(growing, 0).strain(points, [9]), along_x(growing, 0, 9)
    assert strain.stretch[0, :2, 1] == pytest.approx([1, 1], abs=0.03)
    assert strain.area[0, :2] == pytest.approx([longer] * 2, abs=0.05)
    assert np.abs(strain.direction[0, :2, 0]) == pytest.approx([1, 1], abs=0.01)
    assert np.isnan(strain.area[0, 2]) and np.isnan(strain.direction[0, 2]).all()


@pytest.fixture(scope="module")
def exported(growing, tmp_path_factory):
    """The folder of `--format measures` with three points."""
    folder = tmp_path_factory.mktemp("measures")
    (folder / "points.csv").write_text("x,y,frame\n22,26,0\n38,26,0\n30,36,0\n")
    growing.save(folder / "run/scene.safetensors")
    options = ("--format", "measures", "--points", str(folder / "points.csv"), "--from-frame", "2", "--to-frame", "8")
    assert main(["export", str(folder / "run"), str(folder / "out"), *options, "--mesh-step", "1"]) == 0
    return folder / "out"


def test_the_table_says_what_the_points_do(growing, exported):
    rows = list(csv.DictReader((exported / "measures.csv").read_text().splitlines()))
    assert [int(row["frame"]) for row in rows] == list(range(10)) and float(rows[5]["seconds"]) == 0.2
    wide = np.array([float(row["distance_mm"]) for row in rows])
    assert wide[0] == pytest.approx(16 / 80 * 50, rel=0.01)
    assert wide[9] / wide[2] == pytest.approx(along_x(growing, 2, 9), rel=0.01)
    areas = np.array([float(row["area_mm2"]) for row in rows])
    assert areas == pytest.approx(wide * 10 / 80 * 50 / 2, rel=0.01)
    assert float(rows[9]["stretch_0"]) == pytest.approx(along_x(growing, 2, 9), abs=0.01)
    for name in ("distance_range95_mm", "area_range95_mm2", "displacement_range95_1_mm"):
        ranges = np.array([float(row[name]) for row in rows])
        assert np.isfinite(ranges).all() and (ranges[:2] >= 0).all() and ranges[9] > 0
    assert float(rows[2]["displacement_range95_1_mm"]) < float(rows[9]["displacement_range95_1_mm"])
    assert float(rows[2]["displacement_1_mm"]) == 0 < float(rows[1]["displacement_1_mm"])
    assert float(rows[9]["path_1_mm"]) == pytest.approx((wide[9] - wide[0]) / 2, abs=0.05)


def test_the_colored_surfaces_hold_the_values(growing, exported):
    vertex = PlyData.read(str(exported / "stretch.ply"))["vertex"]
    assert np.nanmedian(vertex["stretch"]) == pytest.approx(along_x(growing, 2, 8), abs=0.01)
    moved = np.abs(vertex["x"]) * (along_x(growing, 2, 8) - 1)
    assert vertex["displacement"] == pytest.approx(moved, abs=0.15)  # a tenth of the Gaussians' spacing
    assert (vertex["displacement_range95"] >= 0).all() and vertex["displacement_range95"].max() > 0
    red = PlyData.read(str(exported / "displacement.ply"))["vertex"]["red"].astype(int)
    assert red[np.argmax(moved)] > red[np.argmin(moved)]
    assert cv2.imread(str(exported / "measures.png")).std() > 20


def vtp(path):
    """The arrays of a .vtp file, by name, as VTK's documentation of its XML files says."""
    (piece,) = ElementTree.parse(path).getroot().iter("Piece")
    found = {}
    for array in piece.iter("DataArray"):
        data = base64.b64decode(array.text)
        assert int.from_bytes(data[:8], "little") == len(data) - 8
        values = np.frombuffer(data[8:], {"Float32": "<f4", "Int32": "<i4"}[array.get("type")])
        found[array.get("Name")] = values.reshape(-1, int(array.get("NumberOfComponents", 1))).squeeze()
    assert len(found["Points"]) == int(piece.get("NumberOfPoints"))
    assert len(found["offsets"]) == int(piece.get("NumberOfPolys")) == len(found["connectivity"]) / 3
    return found


def test_the_surface_over_time_has_its_values_for_vtk(growing, exported):
    sets = list(ElementTree.parse(exported / "surface.pvd").getroot().iter("DataSet"))
    assert [each.get("file") for each in sets] == [f"surface/{i:06d}.vtp" for i in range(2, 9)]
    assert [float(each.get("timestep")) for each in sets] == pytest.approx([i / 25 for i in range(2, 9)])
    first, last = (vtp(exported / each.get("file")) for each in (sets[0], sets[-1]))
    assert not first["displacement"].any() and np.nanmax(np.abs(first["stretch"] - 1)) < 1e-5
    vertex = PlyData.read(str(exported / "stretch.ply"))["vertex"]
    assert first["Points"] == pytest.approx(np.stack([vertex[axis] for axis in "xyz"], 1), abs=1e-4)
    assert last["displacement"] == pytest.approx(vertex["displacement"], abs=1e-5)
    np.testing.assert_allclose(last["stretch"], vertex["stretch"], rtol=1e-6)
    np.testing.assert_allclose(last["area_change"], last["stretch"] * last["stretch_smallest"], rtol=1e-5)
    # Exported axes are OpenCV's unless asked otherwise; it grows along x.
    assert np.nanmedian(np.abs(last["direction"][:, 0])) == pytest.approx(1, abs=0.01)
    wide = np.ptp(last["Points"][:, 0]) / np.ptp(first["Points"][:, 0])
    assert wide == pytest.approx(along_x(growing, 2, 8), rel=0.02)
    assert last["offsets"][-1] == len(last["connectivity"]) and last["connectivity"].max() < len(last["Points"])


def test_vtk_finds_the_values(exported):
    vtk = pytest.importorskip("vtk", reason="THE SURFACES ARE NOT READ BY VTK: `pip install vtk`")
    reader = vtk.vtkXMLPolyDataReader()
    reader.SetFileName(str(exported / "surface/000008.vtp"))
    reader.Update()
    found, values = reader.GetOutput(), vtp(exported / "surface/000008.vtp")
    assert found.GetPointData().GetScalars().GetName() == "displacement"
    assert found.GetNumberOfPolys() == len(values["offsets"])
    for name in ("displacement", "stretch"):
        array = found.GetPointData().GetArray(name)
        got = [array.GetValue(i) for i in range(0, array.GetNumberOfValues(), 50)]
        np.testing.assert_allclose(got, values[name][::50])


def test_without_points_there_is_no_table_and_relative_lengths_are_not_mm(growing, tmp_path):
    replace(growing, lengths_are_relative=True).save(tmp_path / "run/scene.safetensors")
    assert main(["export", str(tmp_path / "run"), str(tmp_path / "out"), "--format", "measures"]) == 0
    assert sorted(path.name for path in (tmp_path / "out").iterdir()) == [
        "displacement.ply",
        "measures.png",
        "stretch.ply",
        "surface",
        "surface.pvd",
    ]
    assert b"unit rel." in (tmp_path / "out" / "surface/000009.vtp").read_bytes()
    assert b"unit rel." in (tmp_path / "out" / "stretch.ply").read_bytes()


@pytest.mark.parametrize(
    "options",
    [("--from-frame", "10"), ("--to-frame", "-1"), ("--from-frame", "3", "--to-frame", "3"), ("--points", "none")],
)
def test_a_mistake_is_one_line_and_leaves_nothing(growing, tmp_path, capsys, options):
    growing.save(tmp_path / "run/scene.safetensors")
    assert main(["export", str(tmp_path / "run"), str(tmp_path / "out"), "--format", "measures", *options]) == 2
    error = capsys.readouterr().err
    assert error.count("\n") == 1 and "Fix:" in error and not (tmp_path / "out").exists()


def test_the_table_takes_confidences_and_leaves_unknown_cells_empty():
    paths = np.zeros((3, 1, 3))
    found = measures_of(paths, np.array([[1.0], [np.nan], [1.2]]), 0, 0)
    rows = list(csv.DictReader(measures_csv(found, 10.0, "rel.", np.array([[1], [0.5], [0.25]])).splitlines()))
    assert list(rows[0])[3:] == ["path_0_rel", "path_raw_0_rel", "displacement_0_rel", "stretch_0", "confidence_0"]
    assert [row["stretch_0"] for row in rows] == ["1.0000", "", "1.2000"]
    assert rows[2]["confidence_0"] == "0.2500" and rows[2]["seconds"] == "0.2000"


def test_color_scales_of_maps():
    values = np.array([0.9, 1.0, 1.3, np.nan])
    low, high = stretch_span(values)
    assert low + high == pytest.approx(2) and 1.28 < high <= 1.3
    assert displacement_span(values)[0] == 0 and stretch_span(np.ones(4)) == pytest.approx((0.95, 1.05))
    assert value_colors(values, (low, high))[3].tolist() == [128] * 3
