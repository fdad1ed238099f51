"""`endoprior export --format tracks`: query points and grids, what hides a point, what cannot be tracked."""

from __future__ import annotations

import csv
import json

import numpy as np
import pytest
from export_scenes import export, moving_run, plane_camera

from endoprior.core.checks import InputError
from endoprior.core.geometry import project
from endoprior.data import load_sequence
from endoprior.export.tracks import grid_query_points
from endoprior.model.carry import carry_points
from endoprior.model.scene_file import load_scene
from endoprior.model.surface import Surface, project_visible, render_surface


@pytest.fixture(scope="module")
def run(tmp_path_factory):
    """A run folder with a scene whose Gaussians and camera move."""
    return moving_run(tmp_path_factory.mktemp("export") / "run")


def read_tracks(file) -> list[dict[str, str]]:
    """Rows of tracks.csv."""
    with file.open(newline="") as text:
        return list(csv.DictReader(text))


def test_tracks_of_query_points(run, tmp_path):
    scene = load_scene(run)
    queries = tmp_path / "points.csv"
    queries.write_text("x,y,frame,name\n30.5,20.5,0,a\n40.25,30,4,b\n")
    assert export(run, tmp_path / "out", "tracks", "--points", str(queries), "--frame", "opengl") == 0
    found = np.load(tmp_path / "out" / "tracks.npz")
    assert found["points"].shape == (10, 2, 3) and found["visible"].shape == (10, 2)
    world = found["points"] * [1, -1, -1]
    for point, (frame, pixel) in enumerate([(0, (30.5, 20.5)), (4, (40.25, 30.0))]):
        # in its own frame each point lies at its pixel, on the rendered surface
        assert found["pixels"][frame, point] == pytest.approx(pixel, abs=1e-2)
        out = scene.render(frame / 10)
        depth = (out.depth / out.alpha).numpy()
        between = depth[29:31, 39:41].mean(0) @ [0.25, 0.75]  # of the pixels centered at 39.5 and 40.5, 29.5 and 30.5
        assert world[frame, point, 2] == pytest.approx(between if point else depth[20, 30], abs=1e-3)
    moved = carry_points(scene, world[[0, 4], [0, 1]].astype(np.float64), np.array([0, 4]), [i / 10 for i in range(10)])
    assert world == pytest.approx(moved, abs=1e-4)
    for i in range(10):
        pixels, _ = project(world[i], scene.cameras[i])
        assert found["pixels"][i] == pytest.approx(pixels, abs=1e-2)
    rows = read_tracks(tmp_path / "out" / "tracks.csv")
    columns = "frame time point x y z u v visible confidence across95 along95"
    assert list(rows[0]) == columns.split() and len(rows) == 20
    for row in rows:
        i, p = int(row["frame"]), int(row["point"])
        assert [float(row[c]) for c in "xyz"] == pytest.approx(found["points"][i, p], abs=1e-3)
        assert float(row["u"]) == pytest.approx(found["pixels"][i, p, 0], abs=1e-3)
        for name in ("confidence", "across95", "along95"):
            assert float(row[name]) == pytest.approx(found[name][i, p], abs=1e-3)
        assert (float(row["time"]), row["visible"]) == (i / 10, str(int(found["visible"][i, p])))
    assert found["visible"].mean() > 0.7


def test_tools_hide_points_where_the_sequence_is_there(run, tmp_path, capsys, make_tiny_sequence):
    assert export(run, tmp_path / "without", "tracks", "--grid-px", "4") == 0
    assert "no tool masks" in capsys.readouterr().out
    without = np.load(tmp_path / "without" / "tracks.npz")
    data = make_tiny_sequence(num_frames=10, width=64, height=48)
    assert export(run, tmp_path / "a", "tracks", "--grid-px", "4", "--data", str(data)) == 0
    assert "no tool masks" not in capsys.readouterr().out
    found = np.load(tmp_path / "a" / "tracks.npz")
    for i, frame in enumerate(load_sequence(data).frames("video")):
        x, y = np.clip(np.floor(found["pixels"][i]), 0, (63, 47)).astype(int).T
        tissue = frame.tissue_mask[y, x]
        assert np.array_equal(found["visible"][i], without["visible"][i] & tissue)
    returned = (found["visible"][1:] & ~found["visible"][:-1]).any()
    assert returned and found["visible"].sum() < without["visible"].sum()
    trained = tmp_path / "run"  # a run says where its sequence is
    trained.mkdir()
    (trained / "config.json").write_text(json.dumps({"data": {"path": str(data)}}))
    (trained / "scene.safetensors").write_bytes((run / "scene.safetensors").read_bytes())
    assert export(trained, tmp_path / "b", "tracks", "--grid-px", "4") == 0
    assert np.array_equal(np.load(tmp_path / "b" / "tracks.npz")["visible"], found["visible"])


def test_a_sequence_that_does_not_fit_is_an_error(run, tmp_path, capsys, tiny_sequence, make_tiny_sequence):
    assert export(run, tmp_path / "out", "tracks", "--data", str(tiny_sequence)) == 2
    assert "expected 10 frames, got 17" in capsys.readouterr().err
    small = make_tiny_sequence("small", num_frames=10)
    assert export(run, tmp_path / "out", "tracks", "--data", str(small)) == 2
    assert "expected 10 frames of 64x48, got 10 frames of 48x40" in capsys.readouterr().err
    assert not (tmp_path / "out").exists()


def test_tracks_behind_tissue_or_outside_the_image_are_not_visible(run):
    scene = load_scene(run)
    surface = render_surface(scene, 0.0, scene.cameras[0], 0.5)
    z = float(surface.depth[24, 32])
    middle = np.array([(32.5 - 30) / 80, (24.5 - 26) / 80, 1.0])
    points = np.stack([middle * z, middle * (z + 10), middle * (z - 10), middle * z + [200, 0, 0], -middle * z])
    assert project_visible(points, surface)[1].tolist() == [True, False, True, False, False]


def test_tracks_of_a_grid_start_on_tissue(run, tmp_path):
    assert export(run, tmp_path / "out", "tracks", "--grid-px", "8") == 0
    found = np.load(tmp_path / "out" / "tracks.npz")
    assert len(found["start_pixel"]) > 20 and (found["start_frame"] == 0).all() and found["visible"][0].all()
    assert set(np.diff(np.unique(found["start_pixel"][:, 0]))) == {8.0}
    assert found["pixels"][0] == pytest.approx(found["start_pixel"], abs=1e-2)


def test_grid_lies_on_pixel_centers_that_show_tissue():
    depth = np.zeros((48, 64), np.float32)
    depth[10:20, 30:] = 50
    surface = Surface(depth, np.zeros((48, 64, 3), np.float32), plane_camera())
    assert grid_query_points(surface, 8).pixels.tolist() == [[x, 12.5] for x in (36.5, 44.5, 52.5, 60.5)]
    with pytest.raises(InputError, match="--grid-px"):
        grid_query_points(surface, 64)


@pytest.mark.parametrize(
    ("text", "said"),
    [
        ("a,b\n1,2\n", "columns"),
        ("x,y,frame\n", "no rows"),
        ("x,y,frame\n1,1,99\n", "99"),
        ("x,y,frame\n1,nan,0\n", "nan"),
        ("x,y,frame\n1,1,0\n", "no surface is rendered"),
    ],
)
def test_query_points_that_cannot_be_tracked(run, tmp_path, capsys, text, said):
    file = tmp_path / "points.csv"
    file.write_text(text)
    assert export(run, tmp_path / "out", "tracks", "--points", str(file)) == 2
    error = capsys.readouterr().err
    assert said in error and error.count("\n") == 1 and not (tmp_path / "out").exists()
