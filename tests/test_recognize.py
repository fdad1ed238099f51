"""Paths that are not what a command expects: the error names what lies there and the command to type."""

import re
import shlex
import shutil

import cv2
import numpy as np
import pytest
from video_files import write_video

from endoprior.cli import main

PREPARED = re.compile(
    r"Fix: `(endoprior prepare .*?)`, then `(endoprior check .*?)`; every step: `(endoprior run .*?)`\."
)


@pytest.fixture
def frames() -> list[np.ndarray]:
    """Six images of one camera, 64x48."""
    noise = np.random.default_rng(0).integers(60, 200, (48, 64, 3), dtype=np.uint8)
    return [np.roll(cv2.GaussianBlur(noise, (0, 0), 3), i, 1) for i in range(6)]


def write_images(folder, frames, suffix=".jpg"):
    folder.mkdir(parents=True)
    for index, frame in enumerate(frames):
        cv2.imwrite(str(folder / f"{index:03d}{suffix}"), frame)
    return folder


def complaint(capsys, *words: object) -> str:
    """The error of a command, one line."""
    assert main([str(word) for word in words]) == 2
    text = capsys.readouterr().err
    assert text.count("\n") == 1
    return text


@pytest.mark.parametrize("command", ["train", "check", "view", "prior"])
def test_every_command_that_takes_data_names_prepare_for_a_video(tmp_path, frames, capsys, command):
    video = write_video(tmp_path / "my clip.mp4", frames)
    out = [tmp_path / "out"] if command in ("train", "prior") else []
    text = complaint(capsys, command, video, *out)
    assert text.startswith(f"endoprior: {video}: expected a sequence folder, got a video. Fix: ")
    data = tmp_path / "my clip_data"
    assert [shlex.split(words) for words in PREPARED.search(text).groups()] == [
        ["endoprior", "prepare", str(video), str(data)],
        ["endoprior", "check", str(data)],
        ["endoprior", "run", str(video), str(tmp_path / "my clip_out")],
    ]
    assert sorted(path.name for path in tmp_path.iterdir()) == ["my clip.mp4"]


@pytest.mark.parametrize(
    "kind",
    ["a video", *(pytest.param(f"a folder {what}", marks=pytest.mark.slow) for what in ("of images", "with a video"))],
)
def test_the_printed_commands_work(tmp_path, frames, capsys, monkeypatch, kind):
    monkeypatch.chdir(tmp_path)
    monkeypatch.setattr("endoprior.check.draw_check", lambda *_: None)
    given = tmp_path / "clip"
    if kind == "a folder of images":
        write_images(given, frames)
    elif kind == "a folder with a video":
        given.mkdir()
        write_video(given / "v.mkv", frames)
    else:
        given = write_video(tmp_path / "v.mkv", frames).rename(tmp_path / "without suffix")
    text = complaint(capsys, "check", given)
    assert f"got {kind}." in text
    for words in PREPARED.search(text).groups()[:2]:
        assert main(shlex.split(words)[1:]) == 0, capsys.readouterr().err


@pytest.mark.parametrize("kind", ["videos", "image folders"])
def test_two_cameras(tmp_path, frames, capsys, kind):
    for side in ("Left", "Right"):
        if kind == "videos":
            write_video(tmp_path / f"case_{side}.mkv", frames)
        else:
            write_images(tmp_path / f"case_{side}", frames)
    suffix = ".mkv" if kind == "videos" else ""
    left, right, out = (tmp_path / f"case_{name}" for name in (f"Left{suffix}", f"Right{suffix}", "Left_data"))
    text = complaint(capsys, "check", tmp_path)
    assert f"got {kind} of two cameras." in text
    assert f"`endoprior prepare {left} {out} --right {right} --calibration FILE`" in text
    assert f"`endoprior run {left} {left.with_name('case_Left_out')} --right {right} --calibration FILE`" in text
    (tmp_path / "calib.ini").write_text("")
    assert f"--calibration {tmp_path}/calib.ini`" in complaint(capsys, "check", tmp_path)
    left.rename(tmp_path / f"other_Left{suffix}")
    assert "of two cameras" not in complaint(capsys, "check", tmp_path)


def test_a_folder_around_or_in_a_sequence(tmp_path, make_tiny_sequence, capsys):
    data = make_tiny_sequence("a b/data")
    text = complaint(capsys, "check", data.parent)
    assert f"got a folder with one sequence folder in it. Fix: Pass '{data}'." in text
    assert f"got a part of a sequence folder. Fix: Pass '{data}'." in complaint(capsys, "check", data / "images")
    shutil.copytree(data, data.parent / "data2")
    assert "expected one of the layouts" in complaint(capsys, "check", data.parent)


def test_the_results_of_run_name_their_parts(tmp_path, make_tiny_sequence, capsys):
    data = make_tiny_sequence("my out/data")
    out, run = data.parent, data.parent / "run"
    run.mkdir()
    for name in ("config.json", "scene.safetensors"):
        (run / name).write_text("{}")
    for command in ("check", "view"):
        text = complaint(capsys, command, out)
        assert f"got a folder with a sequence and a run in it. Fix: Pass '{data}'; the run is '{run}'." in text
    for command in ("eval", "render"):
        text = complaint(capsys, command, out)
        assert f"{out}: expected a run folder, got a folder with a run in it. Fix: Pass '{run}'." in text


def test_a_run_where_a_sequence_is_expected(tmp_path, make_tiny_sequence, capsys):
    run = tmp_path / "run"
    run.mkdir()
    (run / "config.json").write_text('{"data": {"path": "/the data"}}')
    (run / "checkpoint.safetensors").touch()
    text = complaint(capsys, "train", run, tmp_path / "out")
    assert f"{run}: expected a sequence folder, got a run folder." in text
    assert f"Fix: `endoprior train --resume {run}` resumes the run; else pass its sequence, '/the data'." in text
    (run / "scene.safetensors").touch()
    assert f"Fix: `endoprior view {run}` shows the run; else" in complaint(capsys, "check", run)
    (run / "config.json").write_text("{")
    assert "shows the run; else pass a sequence folder." in complaint(capsys, "check", run)
    assert "got a file of a run." in complaint(capsys, "check", run / "scene.safetensors")


def test_a_stopped_run_in_windows_is_a_run(tmp_path, capsys):
    run = tmp_path / "run"
    (run / "windows" / "000").mkdir(parents=True)
    (run / "config.json").write_text('{"data": {"path": "/the data"}}')
    for command in ("check", "view"):
        text = complaint(capsys, command, run)
        assert f"got a run folder. Fix: `endoprior train --resume {run}` resumes the run; else" in text


@pytest.mark.parametrize("command", ["eval", "render", "export"])
def test_a_sequence_or_a_video_where_a_run_is_expected(tmp_path, make_tiny_sequence, frames, capsys, command):
    data, out = make_tiny_sequence("data"), []
    if command == "export":
        out = [tmp_path / "out", "--format", "ply"]
    text = complaint(capsys, command, data, *out)
    assert f"{data}: expected a run folder, got a sequence folder. Fix: `endoprior train {data} RUN`" in text
    video = write_video(tmp_path / "v.mkv", frames)
    made = tmp_path / "v_out"
    text = complaint(capsys, command, video, *out)
    assert f"expected a run folder, got a video. Fix: `endoprior run {video} {made}`, then pass {made / 'run'}." in text
    images = write_images(tmp_path / "frames", frames)
    text = complaint(capsys, command, images, *out)
    assert f"{images}: expected a run folder, got a folder of images. Fix: `endoprior run {images} " in text
    nowhere = tmp_path / "nowhere"
    text = complaint(capsys, command, nowhere, *out)
    assert f"{nowhere}: expected a run folder, got no such folder. Fix: Correct the path" in text


def test_what_is_not_there_may_have_been_a_run_or_a_sequence(tmp_path, capsys):
    nowhere = tmp_path / "nowhere"
    text = complaint(capsys, "view", nowhere)
    assert f"{nowhere}: expected a run folder or a sequence folder, got no such folder. Fix: Correct the path" in text


def test_archives_and_what_is_not_recognized(tmp_path, capsys):
    for name in ("data.zip", "data.tar.gz"):
        (tmp_path / name).write_bytes(b"PK")
        assert "got an archive. Fix: Unpack it and pass the folder." in complaint(capsys, "check", tmp_path / name)
    (tmp_path / "notes.txt").write_text("no video")
    assert "got a file. Fix: Pass the folder that holds images/" in complaint(capsys, "check", tmp_path / "notes.txt")
    assert "got no such folder." in complaint(capsys, "check", tmp_path / "nowhere")
    (tmp_path / "empty").mkdir()
    assert "got an empty folder." in complaint(capsys, "check", tmp_path / "empty")
