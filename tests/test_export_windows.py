"""`endoprior export` of a scene of several windows: every format, and what such a scene does not have."""

from __future__ import annotations

from dataclasses import replace
from importlib.util import find_spec
from pathlib import Path

import pytest
import torch
from export_scenes import moving_scene, plane_camera
from plyfile import PlyData

from endoprior.cli import main
from endoprior.model.scene_file import load_scene
from endoprior.model.windowed_scene import Span, WindowedScene

needs_usd = pytest.mark.skipif(find_spec("pxr") is None, reason="USD files need the usd-core package")
SPANS = ((0, 10), (6, 16))
"""Frames of two windows; both show at 6 to 9."""


@pytest.fixture(scope="module")
def run(tmp_path_factory) -> Path:
    """A run folder with two windows; the camera moves in the first six frames only."""
    one = moving_scene()
    cameras = tuple(plane_camera(shift=min(0.5 * i, 3)) for i in range(16))
    parts = [replace(one, cameras=cameras[start:stop]) for start, stop in SPANS]
    spans = tuple(Span(start, stop, len(one)) for start, stop in SPANS)
    scene = WindowedScene(one.config, cameras, one.frames_per_second, spans, parts.__getitem__)
    folder = tmp_path_factory.mktemp("windows") / "run"
    folder.mkdir()
    scene.save(folder / "scene.safetensors")
    return folder


def export(run: Path, out: Path, *options: str) -> int:
    return main(["export", str(run), str(out), *options])


@pytest.mark.parametrize(
    ("name", "options"),
    [
        ("x.splat", ["--times", "0.45"]),
        ("x.spz", ["--times", "0.45"]),
        ("x.glb", ["--times", "0.45"]),
        ("x.ply", ["--format", "points", "--times", "0.45"]),
        ("x.obj", ["--times", "0.45"]),
        ("x.stl", ["--times", "0.1", "--mesh-method", "tsdf", "--voxel-mm", "2"]),
        ("moving.glb", ["--format", "animation", "--mesh-step", "8"]),
        pytest.param("x.usdz", ["--mesh-step", "8"], marks=needs_usd),
        ("x.mrb", ["--mesh-step", "8", "--split", "test"]),
        ("x.mp4", ["--split", "test"]),
        ("x.html", []),
        ("out", ["--format", "depth", "--split", "test"]),
        ("out", ["--format", "tracks"]),
        ("out", ["--format", "measures", "--mesh-step", "8"]),
    ],
    ids=lambda value: value if isinstance(value, str) else " ".join(value),
)
def test_every_format_is_written(run, tmp_path, name, options):
    assert export(run, tmp_path / name, *options) == 0
    out = tmp_path / name
    assert any(out.iterdir()) if out.is_dir() else out.stat().st_size > 100


def test_a_time_has_the_gaussians_of_the_windows_that_it_shows(run, tmp_path, capsys):
    scene = load_scene(run)
    for time, windows in ((0.1, 1), (0.5, 2), (0.9, 1)):
        out = tmp_path / f"{windows}_{time}.ply"
        assert export(run, out, "--times", str(time)) == 0
        assert len(PlyData.read(str(out))["vertex"]) == windows * len(scene) // 2
    assert f"{len(scene):,} Gaussians" not in capsys.readouterr().err


def test_the_whole_scene_is_a_folder_beside_which_nothing_is_written(run, tmp_path):
    out = tmp_path / "whole.safetensors"
    assert export(run, out) == 0
    assert [path.name for path in tmp_path.iterdir()] == ["whole.safetensors"]
    want, got = load_scene(run), load_scene(out)
    for time in (0.1, 0.45, 0.9):
        assert torch.equal(got.render(time).color, want.render(time).color)
    assert export(run, out) == 2


@pytest.mark.parametrize("name", ["x.ply", "x.spz", "x.splat", "x.glb"])
def test_there_is_no_canonical_state(run, tmp_path, capsys, name):
    assert export(run, tmp_path / name, "--canonical") == 2
    said = capsys.readouterr().err.strip()
    assert "--canonical: expected a scene of one window, got 2 windows" in said and "\n" not in said
    assert not list(tmp_path.iterdir())


def test_a_fused_mesh_takes_the_cameras_of_the_windows_shown(run, tmp_path, capsys):
    assert len({camera.world_to_camera.tobytes() for camera in load_scene(run).cameras[6:]}) == 1
    assert export(run, tmp_path / "x.obj", "--mesh-method", "tsdf", "--times", "0.9") == 2
    assert "expected several camera positions, got one" in capsys.readouterr().err
    assert not list(tmp_path.iterdir())
