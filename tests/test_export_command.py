"""`endoprior export`: every format from the command line, tracks, depth, points, and one line for every mistake."""

from __future__ import annotations

import csv
import json
import re
from dataclasses import replace

import cv2
import numpy as np
import pytest
import torch
import trimesh
from export_readers import read_glb, read_spz
from export_scenes import moving_scene, plane_camera
from plyfile import PlyData

from endoprior.cli import main
from endoprior.core.checks import InputError
from endoprior.core.geometry import project
from endoprior.data import load_sequence
from endoprior.export.axes import points_in_axes
from endoprior.export.depth import depth_png
from endoprior.export.formats import FORMATS, formats_of, load_format
from endoprior.export.tracks import grid_query_points
from endoprior.model.carry import carry_points
from endoprior.model.scene import load_scene
from endoprior.model.surface import Surface, project_visible, render_surface
from endoprior.render import sh


@pytest.fixture(scope="module")
def run(tmp_path_factory):
    """A run folder with a scene whose Gaussians and camera move."""
    folder = tmp_path_factory.mktemp("export") / "run"
    moving_scene(sh_degree=1, moving_camera=True).save(folder / "scene.safetensors")
    return folder


def export(run, out, *options: str) -> int:
    """Exit status of the command."""
    return main(["export", str(run), str(out), "--format", *options])


def positions(file) -> np.ndarray:
    """(N, 3) of a PLY file."""
    vertex = PlyData.read(str(file))["vertex"]
    return np.column_stack([vertex[c] for c in "xyz"])


def test_ply_of_all_frames_and_their_index(run, tmp_path):
    scene = load_scene(run)
    assert export(run, tmp_path / "out", "ply", "--frame", "lps") == 0
    names = sorted(p.name for p in (tmp_path / "out").iterdir())
    assert names == [f"{i:06d}.ply" for i in range(10)] + ["index.json"]
    index = json.loads((tmp_path / "out" / "index.json").read_text())
    assert (index["axes"], index["unit"], index["frames_per_second"]) == ("lps", "mm", 25.0)
    assert b"comment axes lps, unit mm\n" in (tmp_path / "out/000000.ply").read_bytes()
    assert index["time_steps"][7] == {"files": ["000007.ply"], "time": 0.7, "frame": 7}
    for i in (0, 7):
        want = points_in_axes(scene.at(i / 10).means.numpy(), "lps")
        assert positions(tmp_path / "out" / f"{i:06d}.ply") == pytest.approx(want, abs=1e-5)


@pytest.mark.parametrize("name", ["x.ply", "x.obj", "x.stl", "x.glb", "x.html", "points.ply", "mesh.ply", "moving.glb"])
def test_no_file_calls_relative_lengths_mm(tmp_path, name):
    scene = replace(moving_scene(sh_degree=1, moving_camera=True), lengths_are_relative=True)
    scene.save(tmp_path / "run/scene.safetensors")
    formats = {"x.glb": "gltf", "points.ply": "points", "mesh.ply": "mesh", "moving.glb": "animation"}
    options = ["--times", "0", "0.5"] if name in ("moving.glb", "x.html") else ["--times", "0"]
    options += ["--format", formats[name]] if name in formats else []
    assert main(["export", str(tmp_path / "run"), str(tmp_path / name), *options]) == 0
    content = (tmp_path / name).read_bytes()
    assert re.search(rb'unit rel\.|"unit": ?"rel\."|Depth, rel\.', content)
    assert not re.search(rb'unit mm|"unit": ?"mm"|Depth, mm', content)


@pytest.mark.parametrize(
    ("options", "names"),
    [
        (("--split", "test"), ["000001", "000009"]),
        (("--times", "0.05", "1"), ["000000", "000001"]),
        (("--canonical",), ["canonical"]),
    ],
)
def test_selected_time_steps(run, tmp_path, options, names):
    assert export(run, tmp_path / "out", "splat", *options) == 0
    assert sorted(p.stem for p in (tmp_path / "out").glob("*.splat")) == names


def test_canonical_is_what_the_scene_stores(run, tmp_path):
    scene = load_scene(run)
    assert export(run, tmp_path / "a.ply", "ply", "--canonical") == 0
    assert np.array_equal(positions(tmp_path / "a.ply"), scene.gaussians["means"].detach().numpy())
    assert export(run, tmp_path / "b.ply", "ply", "--times", "0.35") == 0
    assert np.array_equal(positions(tmp_path / "b.ply"), scene.at(0.35).means.numpy())


@pytest.mark.parametrize("name", ["ply", "splat", "spz", "gltf", "points"])
def test_scenes_where_nothing_but_the_centers_moves(tmp_path, name):
    """What no deformation touches is the trained tensor itself."""
    scene = moving_scene()
    still = replace(scene.config.deformation, deform_quats=False, deform_scales=False)
    still = replace(still, basis=replace(still.basis, deform_color=False))
    with torch.no_grad():
        scene.gaussians.tensors["motion"] = scene.gaussians["motion"][:, :, :3].contiguous().requires_grad_()
    scene = replace(scene, config=replace(scene.config, deformation=still))
    scene.save(tmp_path / "run" / "scene.safetensors")
    assert export(tmp_path / "run", tmp_path / "out", name, "--times", "0.5") == 0
    assert export(tmp_path / "run", tmp_path / "still", name, "--canonical") == 0


def test_axes_default_to_what_the_format_demands(run, tmp_path):
    scene, times = load_scene(run), ("--times", "0.5")
    upright = scene.at(0.5).means.numpy() * [1, -1, -1]
    assert export(run, tmp_path / "a.spz", "spz", *times) == export(run, tmp_path / "a.glb", "gltf", *times) == 0
    assert read_spz((tmp_path / "a.spz").read_bytes())["means"] == pytest.approx(upright, abs=2e-4)
    _, arrays = read_glb((tmp_path / "a.glb").read_bytes(), tmp_path)
    assert arrays["POSITION"] == pytest.approx(upright, abs=1e-5)


def test_points_are_the_opaque_gaussians_in_their_color(run, tmp_path):
    scene = load_scene(run)
    with torch.no_grad():
        scene.gaussians["opacity_logits"][::3] = -4
    scene.save(tmp_path / "run" / "scene.safetensors")
    assert export(tmp_path / "run", tmp_path / "p.ply", "points", "--times", "0.5") == 0
    splats = scene.at(0.5)
    kept = splats.opacities > 0.5
    assert 0 < kept.sum() < len(splats)
    assert np.array_equal(positions(tmp_path / "p.ply"), splats.means[kept].numpy())
    vertex = PlyData.read(str(tmp_path / "p.ply"))["vertex"]
    away = splats.means[kept] - torch.tensor([5.0, 0, 0])  # frame 5 was taken 5 mm to the right
    want = sh.colors(splats.sh[kept], away / away.norm(dim=1, keepdim=True)).clamp(max=1)
    found = np.column_stack([vertex[c] for c in ("red", "green", "blue")])
    assert found / 255 == pytest.approx(want.numpy(), abs=0.51 / 255)
    assert export(tmp_path / "run", tmp_path / "q.ply", "points", "--times", "0", "--min-opacity", "1") == 2


def test_depth_in_both_files(run, tmp_path):
    assert export(run, tmp_path / "out", "depth", "--times", "0.2") == 0
    png = cv2.imread(str(tmp_path / "out" / "000000.png"), cv2.IMREAD_UNCHANGED)
    depth = np.load(tmp_path / "out" / "000000.npy")
    assert png.dtype == np.uint16 and depth.dtype == np.float32 and png.shape == depth.shape == (48, 64)
    out = load_scene(run).render(0.2)
    shown = out.alpha.numpy() >= 0.5
    assert np.array_equal(depth > 0, shown) and np.array_equal(png > 0, shown)
    assert depth[shown] == pytest.approx((out.depth / out.alpha).numpy()[shown], rel=1e-6)
    assert png * 0.01 == pytest.approx(depth, abs=0.005 + 1e-5)


def test_depth_beyond_16_bits_is_missing():
    depth = np.float32([[655.35, 655.36, 700.0, 0.0, 0.01]])
    stored = cv2.imdecode(np.frombuffer(depth_png(depth), np.uint8), cv2.IMREAD_UNCHANGED)
    assert stored.tolist() == [[65535, 0, 0, 0, 1]]


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
    assert (
        list(rows[0]) == ["frame", "time", "point", "x", "y", "z", "u", "v", "visible", "confidence"]
        and len(rows) == 20
    )
    for row in rows:
        i, p = int(row["frame"]), int(row["point"])
        assert [float(row[c]) for c in "xyz"] == pytest.approx(found["points"][i, p], abs=1e-3)
        assert float(row["u"]) == pytest.approx(found["pixels"][i, p, 0], abs=1e-3)
        assert float(row["confidence"]) == pytest.approx(found["confidence"][i, p], abs=1e-3)
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


def test_mesh_of_a_scene_is_its_wall(run, tmp_path):
    options = ("mesh", "--times", "0.5", "--mesh-format")
    assert export(run, tmp_path / "a.ply", *options, "ply", "--mesh-step", "1") == 0
    vertices = trimesh.load(tmp_path / "a.ply", process=False).vertices
    assert np.abs(vertices[:, 2] - (60 + 0.2 * vertices[:, 0])).mean() < 1.0  # the Gaussians are 1 mm wide
    tsdf = ("stl", "--mesh-method", "tsdf", "--voxel-mm", "1.5", "--frame", "opengl")
    assert export(run, tmp_path / "b.stl", *options, *tsdf) == 0
    fused = trimesh.load(tmp_path / "b.stl").vertices * [1, -1, -1]
    inner = (np.abs(fused[:, 0]) < 15) & (np.abs(fused[:, 1]) < 12)
    assert inner.sum() > 100 and np.abs(fused[inner, 2] - (60 + 0.2 * fused[inner, 0])).mean() < 1.0


@pytest.mark.parametrize(
    ("name", "options", "start"),
    [
        ("a.ply", ("--times", "0.5"), b"ply"),
        ("a.splat", ("--times", "0.5"), None),
        ("a.spz", ("--times", "0.5"), b"\x1f\x8b"),
        ("a.glb", ("--times", "0.5"), b"glTF"),
        ("a.obj", ("--times", "0.5"), b"# endoprior"),
        ("a.stl", ("--times", "0.5"), b"endoprior"),
        ("a.obj", ("--times", "0.5", "--format", "mesh"), b"# endoprior"),
        ("a.safetensors", (), None),
        ("a.npy", ("--times", "0.5"), b"\x93NUMPY"),
    ],
)
def test_the_suffix_says_the_format(run, tmp_path, name, options, start):
    assert main(["export", str(run), str(tmp_path / name), *options]) == 0
    assert (tmp_path / name).read_bytes().startswith(start or b"")


def test_every_suffix_has_a_format_and_ambiguous_ones_the_first():
    formats = {name: load_format(name) for name in FORMATS}
    for suffix in {suffix for each in formats.values() for suffix in each.suffixes}:
        assert suffix in formats[formats_of(suffix)[0]].suffixes
    table = {".ply": "ply", ".obj": "mesh", ".stl": "mesh", ".mp4": "video", ".html": "html", ".png": "depth"}
    assert {suffix: formats_of(suffix)[0] for suffix in table} == table
    assert formats_of("") == []


@pytest.mark.parametrize("name", ["folder", "a.fbx"])
def test_a_name_without_a_known_suffix_lists_the_formats(run, tmp_path, capsys, name):
    assert main(["export", str(run), str(tmp_path / name)]) == 2
    error = capsys.readouterr().err
    assert ".ply .splat .spz .glb .obj .stl .mrb " in error
    assert ", ".join(FORMATS) in error and error.count("\n") == 1 and not list(tmp_path.iterdir())


@pytest.mark.parametrize(
    ("name", "options", "words"),
    [
        ("a.ply", (), "{count} Gaussians; for colored points: --format points; for a mesh: --format mesh"),
        ("a.glb", (), "{count} Gaussians; for a moving mesh: --format animation"),
        ("a.obj", (), "a mesh"),
        ("a.ply", ("--format", "mesh"), "a mesh"),
        ("folder", ("--format", "spz"), "{count} Gaussians, one file for each time step"),
    ],
)
def test_the_command_says_what_it_wrote(run, tmp_path, capsys, name, options, words):
    out = tmp_path / name
    assert main(["export", str(run), str(out), "--times", "0.5", *options]) == 0
    count = f"{len(load_scene(run)):,}"
    assert f"{out}: {words.format(count=count)}\n" in capsys.readouterr().out


def test_an_existing_file_is_kept_unless_it_may_be_overwritten(run, tmp_path, capsys):
    out = tmp_path / "a.ply"
    out.write_text("mine")
    words = ["export", str(run), str(out), "--times", "0.5"]
    assert main(words) == 2 and out.read_text() == "mine"
    fix = "Fix: Choose another name, or add --overwrite."
    assert capsys.readouterr().err == f"endoprior: {out}: expected a new file, got one that exists. {fix}\n"
    assert main([*words, "--overwrite"]) == 0 and out.read_bytes().startswith(b"ply")


def test_video_has_the_frames_of_the_split(run, tmp_path):
    assert export(run, tmp_path / "v.mp4", "video", "--split", "train") == 0
    video, frames = cv2.VideoCapture(str(tmp_path / "v.mp4")), []
    while (read := video.read())[0]:
        frames.append(read[1][..., ::-1])
    video.release()
    assert len(frames) == 8 and frames[0].shape == (48, 64, 3)
    scene = load_scene(run)
    own, first = (scene.render(0.8, scene.cameras[i]).color.clamp(0, 1).numpy() * 255 for i in (8, 0))
    errors = [np.abs(frames[-1].astype(float) - want).mean() for want in (own, first)]
    assert errors[0] < 12 and errors[0] < errors[1] / 2  # compressed, and from where frame 8 was taken


def test_scene_is_the_file_of_the_run(run, tmp_path):
    assert export(run, tmp_path / "s.safetensors", "scene") == 0
    assert (tmp_path / "s.safetensors").read_bytes() == (run / "scene.safetensors").read_bytes()


@pytest.mark.parametrize(
    ("out", "options", "said"),
    [
        ("a.ply", ("ply",), "--times"),
        ("a.glb", ("gltf",), "or --format animation for all of them."),
        ("a.ply", ("ply", "--times", "2"), "times must be in"),
        ("a.splat", ("ply", "--times", "0"), ".ply"),
        ("a.stl", ("mesh", "--times", "0", "--mesh-format", "obj"), "Remove --mesh-format"),
        ("a", ("ply", "--canonical", "--times", "0"), "several"),
        ("a", ("mesh", "--canonical"), "--canonical"),
        ("a", ("ply", "--mesh-format", "obj"), "--mesh-format"),
        ("a", ("depth", "--frame", "ras"), "--frame"),
        ("a", ("video",), ".mp4"),
        ("a", ("nonsense",), "nonsense"),
        ("a", ("mesh", "--mesh-step", "0"), "mesh_step"),
        ("a", ("tracks", "--points", "missing.csv"), "missing.csv"),
        ("full", ("ply",), "empty folder"),
        ("file/x.ply", ("ply", "--times", "0"), "file"),
    ],
)
def test_a_mistake_is_one_line_and_leaves_nothing(run, tmp_path, capsys, out, options, said):
    (tmp_path / "full").mkdir()
    (tmp_path / "full" / "something").touch()
    (tmp_path / "file").touch()
    before = sorted(tmp_path.rglob("*"))
    assert export(run, tmp_path / out, *options) == 2
    error = capsys.readouterr().err
    assert said in error and error.count("\n") == 1
    assert sorted(tmp_path.rglob("*")) == before


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


def test_a_failure_leaves_nothing(run, tmp_path, monkeypatch):
    from endoprior.export import ply

    calls = []

    def broken(*args):
        calls.append(args)
        if len(calls) == 3:
            raise RuntimeError("broken")
        return b"x"

    monkeypatch.setattr(ply, "encode_ply", broken)
    with pytest.raises(RuntimeError):
        export(run, tmp_path / "out", "ply")
    assert not list(tmp_path.iterdir())
