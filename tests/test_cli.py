"""The command line: exit statuses, one-line error messages, and the main path from a folder to scores and a video."""

import json
import math
import shutil
from pathlib import Path

import cv2
import numpy as np
import pytest

from endoprior.cli import descriptions, main
from endoprior.cli.check import figure_beside
from endoprior.cli.view import open_viewable

QUICK = [
    "--init-budget", "300", "--schedule.coarse-iterations", "2", "--schedule.fine-iterations", "20",
    "--schedule.half-resolution-iterations", "4", "--no-networks",
]  # fmt: skip


@pytest.fixture(scope="module")
def run(tmp_path_factory):
    """A quickly trained run folder and its sequence."""
    from conftest import write_tiny_sequence

    folder = tmp_path_factory.mktemp("cli")
    data = write_tiny_sequence(folder / "tiny")
    assert main(["train", str(data), str(folder / "run"), *QUICK]) == 0
    return data, folder / "run"


def complaint(capsys) -> str:
    """The one line on stderr."""
    text = capsys.readouterr().err
    assert text.startswith("endoprior: ") and text.count("\n") == 1 and "Traceback" not in text
    return text


def test_overview_names_every_command(capsys):
    assert main(["--help"]) == 0
    text = capsys.readouterr().out
    assert all(name in text for name in descriptions())


@pytest.mark.parametrize(
    ("arguments", "says"),
    [
        (["trian"], "trian: expected one of run, demo, "),
        (["zzz"], "got no such command. Fix: `endoprior --help` explains each."),
        (["train", "nowhere", "out"], "nowhere"),
        (["train", "nowhere", "out", "--preset", "finest"], "--preset"),
        (["train", "nowhere", "out", "--device", "cuda"], "--device"),
        (["train", "nowhere", "out", "--render.backend", "triton"], "a GPU that torch can use, got none here"),
        (["train", "nowhere", "out", "--render.backend", "gsplat", "--device", "cpu"], "--render.backend gsplat"),
        (["train", "nowhere", "out", "--weights-dir", "no-weights"], "no-weights"),
        (["eval", "nowhere", "--protocol", "nerf"], "got 'nerf'. Fix: See docs/scores.md."),
        (["render", "nowhere", "--times", "1.5"], "--times: expected times in [0, 1], got 1.5"),
        (["prior", "nowhere", "out"], "nowhere"),
        (["phantom", "out", "--frames", "1"], "frames"),
    ],
)
def test_bad_usage_is_one_line_and_status_2(arguments, says, capsys, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    monkeypatch.setattr("endoprior.cli.devices.why_no_gpu", lambda: "none here")
    assert main(arguments) == 2
    assert says in complaint(capsys)
    assert list(tmp_path.iterdir()) == [], "something was left behind"


def test_train_scores_and_reports_skipped_scores(run):
    _, folder = run
    metrics = json.loads((folder / "metrics.json").read_text())
    assert set(metrics) == {"protocol", "scores", "skipped"}
    expected = {"psnr", "psnr_tissue", "ssim", "depth_rmse_mm", "flow_error_dis", "depth_instability_mm"}
    expected |= {"num_gaussians", "gaussians_growth", "num_low_prior", "num_low_opacity", "num_large_scale"}
    expected |= {"fps", "fps_cached", "train_seconds", "iterations_per_second"}
    assert expected <= set(metrics["scores"])
    assert {"flow_error", "lpips"} <= set(metrics["skipped"])
    assert metrics["protocol"]["frames"] == [1, 9]
    per_frame = json.loads((folder / "per_frame.json").read_text())
    assert [row["index"] for row in per_frame] == [1, 9]
    assert metrics["scores"]["psnr_tissue"] == pytest.approx(np.mean([row["psnr_tissue"] for row in per_frame]))


def test_train_ends_with_what_to_type_next(tiny_sequence, tmp_path, capsys):
    words = ["--iterations", "2", "--gaussians", "200", "--no-networks"]
    assert main(["train", str(tiny_sequence), str(tmp_path / "r"), *words]) == 0
    assert capsys.readouterr().out.endswith(f"To turn and measure it: `endoprior view {tmp_path / 'r'}`\n")


def test_eval_repeats_the_scores_of_train(run, tmp_path):
    _, folder = run
    assert main(["eval", str(folder), "--out", str(tmp_path), "--no-networks"]) == 0
    first, second = (json.loads((place / "metrics.json").read_text())["scores"] for place in (folder, tmp_path))
    timed = dict.fromkeys(("fps", "fps_cached", "train_seconds", "iterations_per_second"))
    assert first | timed == second | timed


@pytest.mark.parametrize("split", ["train", "video"])
def test_another_split_does_not_replace_the_test_scores(run, split, capsys):
    _, folder = run
    before = {name: (folder / name).read_bytes() for name in ("metrics.json", "per_frame.json")}
    assert main(["eval", str(folder), "--split", split, "--no-networks"]) == 0
    assert {name: (folder / name).read_bytes() for name in before} == before
    metrics = json.loads((folder / f"metrics_{split}.json").read_text())
    rows = json.loads((folder / f"per_frame_{split}.json").read_text())
    assert metrics["protocol"]["split"] == split and metrics["protocol"]["frames"] == [row["index"] for row in rows]
    assert str(folder / f"metrics_{split}.json") in capsys.readouterr().out.splitlines()[-1]


def test_protocols_of_other_papers_stand_beside_our_scores(run, tmp_path):
    _, folder = run
    words = ["eval", str(folder), "--out", str(tmp_path), "--no-networks", "--split", "video"]
    assert main([*words, "--protocol", "endonerf,endogaussian"]) == 0
    metrics = json.loads((tmp_path / "metrics_video.json").read_text())
    ours, theirs = metrics["protocol"]["tags"], metrics["protocols"]["endonerf"]["tags"]
    assert ours["split"] == "video, 17 frames" and theirs["split"] == "video, 16 without 0"
    assert ours["saw_test_frames"] == "yes: 15 of 17" and theirs["saw_test_frames"] == "yes: 14 of 16"
    assert ours["background"] == theirs["background"] == "black"
    same, other = (metrics["protocols"][name]["scores"]["psnr"] for name in ("endogaussian", "endonerf"))
    assert same == pytest.approx(metrics["scores"]["psnr"], abs=1e-6) != other
    stored = json.loads((folder / "metrics.json").read_text())["protocol"]["tags"]
    assert (stored["saw_test_frames"], stored["split"]) == ("no", "test, 2 frames")


def test_eval_of_other_data_is_an_error(run, make_tiny_sequence, capsys):
    _, folder = run
    assert main(["eval", str(folder), "--data", str(make_tiny_sequence("short", num_frames=9))]) == 2
    assert "17 frames" in complaint(capsys)


def test_eval_without_its_sequence_is_an_error(run, tmp_path, capsys):
    _, folder = run
    shutil.copytree(folder, tmp_path / "moved")
    facts = json.loads((tmp_path / "moved" / "config.json").read_text())
    facts["data"]["path"] = "/gone"
    (tmp_path / "moved" / "config.json").write_text(json.dumps(facts))
    assert main(["eval", str(tmp_path / "moved")]) == 2
    assert "--data" in complaint(capsys)


def test_render_writes_frames_depth_and_a_video(run, tmp_path):
    _, folder = run
    assert main(["render", str(folder), str(tmp_path / "out"), "--split", "test"]) == 0
    assert sorted(p.name for p in (tmp_path / "out" / "rgb").iterdir()) == ["000001.png", "000009.png"]
    assert cv2.imread(str(tmp_path / "out" / "rgb" / "000001.png")).shape == (40, 48, 3)
    depth = np.load(tmp_path / "out" / "depth" / "000009.npy")
    assert depth.shape == (40, 48) and depth.dtype == np.float32
    assert cv2.imread(str(tmp_path / "out" / "side_by_side" / "000001.png")).shape == (40, 3 * 48, 3)
    film = cv2.VideoCapture(str(tmp_path / "out" / "video.mp4"))
    assert int(film.get(cv2.CAP_PROP_FRAME_COUNT)) == 2


def test_pictures_without_highlights_stay_beside_those_with_them(run, tmp_path):
    folder = shutil.copytree(run[1], tmp_path / "copy")
    (folder / "video.mp4").write_bytes(b"with")
    assert main(["render", str(folder), "--split", "test", "--no-highlights"]) == 0
    names = [path.name for path in sorted((folder / "renders" / "no_highlights" / "rgb").iterdir())]
    assert names == ["000001.png", "000009.png"] and (folder / "video.mp4").read_bytes() == b"with"
    assert (folder / "video_no_highlights.mp4").exists()


def test_render_of_what_was_seen(run, tmp_path):
    _, folder = run
    assert main(["render", str(folder), str(tmp_path / "out"), "--split", "test", "--layer", "support"]) == 0
    folder = tmp_path / "out" / "support"
    assert sorted(p.name for p in folder.iterdir()) == [f"{k:06d}.{end}" for k in (1, 9) for end in ("npy", "png")]
    counts = np.load(folder / "000001.npy")
    assert counts.shape == (40, 48, 2) and counts.dtype == np.float32 and np.nanmax(counts[..., 0]) > 1
    assert (tmp_path / "out" / "support.mp4").exists()


def test_render_of_chosen_times_and_a_camera_path(run, tmp_path, capsys):
    _, folder = run
    assert main(["render", str(folder), str(tmp_path / "a"), "--times", "0", "0.5", "--camera", "sway"]) == 0
    assert len(list((tmp_path / "a" / "rgb").iterdir())) == 2
    assert "other images" not in capsys.readouterr().out
    assert main(["render", str(folder), str(tmp_path / "a"), "--times", "0.5"]) == 0
    assert "rgb before: 1" in capsys.readouterr().out
    moved = np.eye(4)
    moved[0, 3] = 2
    path = tmp_path / "path.json"
    path.write_text(json.dumps([{"time": 0.2}, {"time": 0.2, "world_to_camera": moved.tolist()}]))
    assert main(["render", str(folder), str(tmp_path / "b"), "--camera-path", str(path)]) == 0
    first, second = (cv2.imread(str(p)).astype(int) for p in sorted((tmp_path / "b" / "rgb").iterdir()))
    assert np.abs(first - second).mean() > 1, "moving the camera changed nothing"
    stretched, unknown = np.diag([2.0, 1, 1, 1]), moved.copy()
    unknown[0, 3] = math.nan
    for matrix in (stretched.tolist(), unknown.tolist(), moved.ravel().tolist()):
        path.write_text(json.dumps([{"time": 0.2, "world_to_camera": matrix}]))
        capsys.readouterr()
        assert main(["render", str(folder), str(tmp_path / "c"), "--camera-path", str(path)]) == 2
        assert "path.json" in complaint(capsys)


@pytest.mark.parametrize(
    ("given", "named"),
    [
        (("--camera-path", "p.json", "--times", "0.5"), "--times"),
        (("--camera-path", "p.json", "--split", "test"), "--split"),
        (("--camera-path", "p.json", "--camera", "sway"), "--camera"),
        (("--times", "0.5", "--split", "train"), "--split"),
    ],
)
def test_two_choices_of_what_to_render_are_rejected(run, tmp_path, capsys, given, named):
    _, folder = run
    assert main(["render", str(folder), str(tmp_path / "out"), *given]) == 2
    assert f"{named}: expected one of {given[0]} and {named}, got both. Fix: Remove" in complaint(capsys)
    assert not (tmp_path / "out").exists()


def test_a_scene_file_is_used_beside_itself(run, tmp_path):
    data, folder = run
    (tmp_path / "sent").mkdir()
    file = tmp_path / "sent/x.safetensors"
    file.write_bytes((folder / "scene.safetensors").read_bytes())
    assert main(["eval", str(file), "--data", str(data), "--no-networks"]) == 0
    assert main(["render", str(file), "--times", "0.5"]) == 0
    viewable, out = open_viewable(file, data)
    assert viewable.has_tool and out == tmp_path / "sent" / "view"
    beside = {"metrics.json", "per_frame.json", "renders", "video.mp4"}
    assert {p.name for p in file.parent.iterdir()} == beside | {file.name}


def test_render_writes_the_carried_grid_beside_the_input(run, tmp_path):
    _, folder = run
    assert main(["render", str(folder), str(tmp_path), "--split", "test", "--layer", "texture"]) == 0
    assert {p.name for p in tmp_path.iterdir()} >= {"texture", "texture.mp4"}
    assert sorted(p.name for p in (tmp_path / "texture").iterdir()) == ["000001.png", "000009.png"]
    assert cv2.imread(str(tmp_path / "texture" / "000001.png")).shape == (40, 2 * 48, 3)
    assert main(["render", str(folder), str(tmp_path), "--times", "0", "--layer", "texture"]) == 0
    assert cv2.imread(str(tmp_path / "texture" / "000000.png")).shape == (40, 48, 3), "no input at a chosen time"


def test_prior_writes_maps_and_a_contact_sheet(run, tmp_path, capsys):
    data, _ = run
    assert main(["prior", str(data), str(tmp_path / "out"), "--split", "test"]) == 0
    for name in ("specular", "salience", "prior"):
        assert len(list((tmp_path / "out" / name).iterdir())) == 2
    rho = cv2.imread(str(tmp_path / "out" / "prior" / "000001.png"), cv2.IMREAD_GRAYSCALE)
    tool = cv2.imread(str(data / "masks" / "000001.png"), cv2.IMREAD_GRAYSCALE) > 0
    assert (rho[tool] == 0).all() and rho[~tool].max() == 255
    assert (tmp_path / "out" / "contact_sheet.png").is_file()
    capsys.readouterr()
    assert main(["prior", str(data), str(tmp_path / "out")]) == 2
    complaint(capsys)


@pytest.mark.parametrize(
    "damage",
    [
        lambda file: file.write_bytes(file.read_bytes()[:-100]),
        lambda file: file.write_bytes(b""),
        lambda file: file.unlink(),
    ],
)
def test_a_damaged_scene_is_named(run, tmp_path, capsys, damage):
    shutil.copytree(run[1], tmp_path / "run")
    damage(tmp_path / "run" / "scene.safetensors")
    assert main(["eval", str(tmp_path / "run")]) == 2
    assert "scene.safetensors" in complaint(capsys)


def test_two_sequences_of_one_name_have_two_figures(tmp_path, monkeypatch):
    for name in ("a", "b"):
        (tmp_path / name / "data").mkdir(parents=True)
    monkeypatch.chdir(tmp_path / "b")
    assert figure_beside(Path("../a/data")) == Path("../a/data_check.png")
    assert figure_beside(Path("data")) == Path("data_check.png")
    monkeypatch.chdir("data")
    assert figure_beside(Path(".")) == tmp_path / "b/data_check.png"
    monkeypatch.setattr("os.access", lambda *_: False)
    assert figure_beside(tmp_path / "a/data") == Path("data_check.png")
