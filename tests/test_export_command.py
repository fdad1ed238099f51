"""`endoprior export`: every format from the command line, depth, points, and one line for every mistake."""

from __future__ import annotations

import re
from dataclasses import replace

import cv2
import numpy as np
import pytest
import torch
import trimesh
from export_readers import read_glb, read_spz
from export_scenes import export, moving_run, moving_scene
from plyfile import PlyData

import endoprior as api
from endoprior.cli import main
from endoprior.core.types import Splats
from endoprior.export.formats import FORMATS, ExportOptions, formats_of, load_format
from endoprior.export.frames import depth_png
from endoprior.model.gaussians import Gaussians
from endoprior.model.scene_file import load_scene
from endoprior.render import load as rasterizer
from endoprior.render import sh

PLY_COLUMNS = {
    "means": ("x", "y", "z"),
    "quats": ("rot_0", "rot_1", "rot_2", "rot_3"),
    "log_scales": ("scale_0", "scale_1", "scale_2"),
    "dc": ("f_dc_0", "f_dc_1", "f_dc_2"),
    "rest": tuple(f"f_rest_{i}" for i in range(9)),
}


@pytest.fixture(scope="module")
def run(tmp_path_factory):
    """A run folder with a scene whose Gaussians and camera move."""
    return moving_run(tmp_path_factory.mktemp("export") / "run")


def positions(file) -> np.ndarray:
    """(N, 3) of a PLY file."""
    vertex = PlyData.read(str(file))["vertex"]
    return np.column_stack([vertex[c] for c in "xyz"])


@pytest.mark.parametrize("name", ["ply", "compressed_ply"])
def test_a_folder_of_ply_holds_nothing_else(run, tmp_path, name):
    """SuperSplat then plays it; with another file in it, it shows all time steps at once."""
    assert export(run, tmp_path / "out", name, "--split", "test") == 0
    assert sorted(p.name for p in (tmp_path / "out").iterdir()) == ["000001.ply", "000009.ply"]
    header = (tmp_path / "out/000009.ply").read_bytes().split(b"end_header")[0].decode().splitlines()
    assert "comment time 0.9, frame 9, frames_per_second 25" in header


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


@pytest.mark.parametrize("name", ["ply", "compressed_ply", "sog", "splat", "spz", "gltf", "points"])
def test_scenes_where_nothing_but_the_centers_moves(tmp_path, name):
    """What no deformation touches is the trained tensor itself."""
    scene = moving_scene()
    still = replace(scene.config.deformation, deform_shape=False)
    with torch.no_grad():
        scene.gaussians.tensors["changes"] = scene.gaussians["changes"][:, :, 7:].contiguous().requires_grad_()  # color
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
        ("a.spz", ("--times", "0.5"), b"\x1f\x8b"),
        ("a.glb", ("--times", "0.5"), b"glTF"),
        ("a.obj", ("--times", "0.5"), b"# endoprior"),
        ("a.stl", ("--times", "0.5"), b"endoprior"),
        ("a.safetensors", (), b""),
        ("a.npy", ("--times", "0.5"), b"\x93NUMPY"),
    ],
)
def test_the_suffix_says_the_format(run, tmp_path, name, options, start):
    assert main(["export", str(run), str(tmp_path / name), *options]) == 0
    assert (tmp_path / name).read_bytes().startswith(start)


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
    assert ".ply .sog .splat .spz .glb .obj .stl .usdz .usdc .mrb .json " in error
    assert ", ".join(FORMATS) in error and error.count("\n") == 1 and not list(tmp_path.iterdir())


@pytest.mark.parametrize(
    ("name", "options", "words"),
    [
        (
            "a.ply",
            (),
            "{count} Gaussians; for compressed Gaussians: --format compressed_ply; for colored points: --format points;"
            " for a mesh: --format mesh",
        ),
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
    said = capsys.readouterr().out
    assert f"{out}: {words.format(count=count)}\n" in said
    assert ("one color for each Gaussian" in said) == ("Gaussians" in words)  # their colors have slopes


def said_psnr(text: str) -> float:
    return float(re.search(r"with a PSNR of ([\d.]+) dB", text)[1])


@pytest.mark.parametrize("axes", ["opencv", "ras"])
def test_the_loss_is_that_of_the_file(run, tmp_path, capsys, axes):
    """Of what plyfile reads, rendered by the reference."""
    scene = load_scene(run)
    assert export(run, tmp_path / "a.ply", "ply", "--times", "0.5", "--frame", axes) == 0
    psnr = said_psnr(capsys.readouterr().out)
    if axes == "opencv":
        vertex = PlyData.read(str(tmp_path / "a.ply"))["vertex"]
        read = {k: np.stack([vertex[name] for name in names], 1) for k, names in PLY_COLUMNS.items()}
        rest = read["rest"].reshape(len(vertex), 3, 3).transpose(0, 2, 1)
        tensors = {
            "means": read["means"],
            "quats": read["quats"],
            "scales": np.exp(read["log_scales"]),
            "opacities": 1 / (1 + np.exp(-vertex["opacity"])),
            "sh": np.concatenate([read["dc"][:, None], rest], 1),
        }
        splats = Splats(**{name: torch.tensor(value) for name, value in tensors.items()})
        image = rasterizer("reference")(splats, scene.camera_at(0.5), background=torch.zeros(3)).color.clamp(0, 1)
        want = -10 * float(torch.log10(((image - scene.render(0.5).color) ** 2).mean()))
        assert psnr == pytest.approx(want, abs=0.051)
    assert export(run, tmp_path / "b.ply", "ply", "--times", "0.5") == 0
    assert psnr == pytest.approx(said_psnr(capsys.readouterr().out), abs=0.051)


def test_a_format_that_keeps_less_loses_more(run, tmp_path, capsys):
    found = []
    for name, file in (("ply", "a.ply"), ("splat", "a.splat")):  # .splat has no direction-dependent color
        assert export(run, tmp_path / file, name, "--times", "0.5") == 0
        found.append(said_psnr(capsys.readouterr().out))
    assert found[0] > found[1] + 3
    assert export(run, tmp_path / "folder", "ply") == 0
    assert "note: the file shows 3 images of the scene with a PSNR of" in capsys.readouterr().out
    assert export(run, tmp_path / "a.obj", "mesh", "--times", "0.5") == 0
    assert "PSNR" not in capsys.readouterr().out


def test_a_file_that_keeps_all_says_so(tmp_path, capsys):
    scene = moving_scene()
    with torch.no_grad():
        scene.gaussians["color_slopes"].zero_()
        scene.gaussians["changes"].zero_()
    cfg = replace(scene.config, render=replace(scene.config.render, color_slopes=False))
    tensors = {name: value for name, value in scene.gaussians.tensors.items() if name != "color_slopes"}
    replace(scene, config=cfg, gaussians=Gaussians(tensors)).save(tmp_path / "run/scene.safetensors")
    assert export(tmp_path / "run", tmp_path / "a.ply", "ply", "--times", "0.5") == 0
    assert "with a PSNR of over 60 dB, no visible difference.\n" in capsys.readouterr().out


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
        ("a.mrb", ("animation",), ".glb"),
        ("a.glb", ("animation", "--times", "0.5"), "two or more"),
        ("a.glb", ("animation", "--times", "0.2", "0.2"), "in order"),
        ("a.glb", ("animation", "--canonical"), "--canonical"),
        ("a.seq.mrb", ("slicer",), "a.mrb"),
        ("a.mrb", ("slicer", "--frame", "ras"), "--frame"),
        ("a.mrb", ("slicer", "--points", "missing.csv"), "missing.csv"),
        ("a.mrb", ("slicer", "--max-slope", "0.01", "--mesh-step", "20", "--min-alpha", "1"), "--min-alpha"),
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


@pytest.mark.parametrize("name", ["a.ply", "a.glb", "a.html"])
def test_a_scene_on_a_gpu_is_exported(run, tmp_path, monkeypatch, name):
    """The device `meta` stands for one whose numbers NumPy cannot read."""
    scene = load_scene(run)
    away = {key: value.to("meta") for key, value in scene.gaussians.tensors.items()}
    on_gpu = replace(scene, gaussians=Gaussians(away))
    monkeypatch.setattr(type(scene), "to", lambda self, device, **_: scene if str(device) == "cpu" else self)
    options = ExportOptions() if name == "a.html" else ExportOptions(times=(0.5,))
    for folder, each in (("there", on_gpu), ("here", scene)):
        api.export(each, tmp_path / folder / name, options)
    assert (tmp_path / "there" / name).read_bytes() == (tmp_path / "here" / name).read_bytes()


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
