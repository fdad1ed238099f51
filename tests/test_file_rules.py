"""What we write, under the file rules of Windows and macOS (`file_rules.py`)."""

from __future__ import annotations

import io
import json
import os
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest
import torch
from export_scenes import moving_scene
from file_rules import case_is_ignored, windows_files
from tiny_training import tiny_config
from video_files import write_video

from endoprior.cli import main
from endoprior.core.checks import InputError
from endoprior.data import load_sequence
from endoprior.export import export
from endoprior.export.formats import ExportOptions
from endoprior.prepare import PrepareConfig, prepare
from endoprior.prepare.work_folder import work_folder
from endoprior.runs.train import train
from endoprior.system.arrays_file import ArraySpec, load_arrays, save_arrays
from endoprior.system.atomic import (
    CannotWrite,
    lies_in,
    remove_leftovers,
    whole_file,
    whole_folder,
    write_json,
    write_text,
)


@pytest.fixture
def windows():
    """The file rules of Windows, during one test."""
    with windows_files():
        yield


def names_in(folder: Path) -> list[str]:
    """Everything below a folder but lock files, which the library removes on Windows itself."""
    return sorted(path.relative_to(folder).as_posix() for path in folder.rglob("*") if path.suffix != ".lock")


def demand_portable(folder: Path) -> None:
    """Text is UTF-8 with plain line ends, nothing is left over, JSON holds no separators of this system."""
    for file in folder.rglob("*"):
        assert ".partial" not in file.name
        if file.suffix in (".json", ".jsonl", ".csv", ".html", ".md"):
            content = file.read_bytes()
            assert b"\r\n" not in content and content.decode("utf-8"), file
        if file.name in ("index.json", "sequence.json"):
            assert os.sep not in json.dumps(json.loads(file.read_bytes())).replace("\\\\", os.sep), file


def test_the_rules_end_with_the_context():
    before = open, io.open, os.open, os.stat, os.unlink, os.rename
    with windows_files():
        pass
    assert before == (open, io.open, os.open, os.stat, os.unlink, os.rename)


@pytest.mark.skipif(sys.platform != "linux", reason="only imposed on Linux")
def test_the_rules_are_those_of_windows(windows, tmp_path):
    file, other = tmp_path / "a.txt", tmp_path / "b.txt"
    file.write_text("ü\n")
    assert file.read_bytes() == b"\xfc\r\n" and (tmp_path / "A.TXT").exists()
    other.touch()
    with open(file, "rb") as opened:
        for attempt in (file.unlink, lambda: other.replace(file), lambda: file.replace(tmp_path / "c")):
            with pytest.raises(PermissionError):
                attempt()
        with pytest.raises(OSError, match="Bad file descriptor"):
            os.fsync(opened.fileno())
        folder = tmp_path / "folder"
        (tmp_path / "x").mkdir()
        with open(tmp_path / "x" / "y", "wb"), pytest.raises(PermissionError):
            (tmp_path / "x").rename(folder)
        (tmp_path / "x").rename(folder)
    mapped = np.memmap(other, np.uint8, "w+", shape=4)
    with pytest.raises(PermissionError):
        file.replace(other)
    del mapped
    folder = tmp_path / "empty"
    folder.mkdir()
    for path in ("aux.json", "12:30.png", "name."):
        with pytest.raises(OSError, match="Invalid argument"):
            (tmp_path / path).write_bytes(b"")
    with pytest.raises(PermissionError):
        os.open(folder, os.O_RDONLY)
    with pytest.raises(PermissionError):
        (tmp_path / "folder").replace(folder)
    with pytest.raises(FileExistsError):
        file.rename(other)


def test_files_and_folders_are_written(windows, tmp_path):
    for text in ("first ü\n", "second ü\n"):
        write_text(tmp_path / "a.txt", text)
        write_json(tmp_path / "a.json", {"name": text})
    assert (tmp_path / "a.txt").read_bytes() == "second ü\n".encode()
    (tmp_path / "out").mkdir()  # an empty folder may exist
    with whole_folder(tmp_path / "out") as folder:
        (folder / "file").write_bytes(b"1")
    with work_folder(tmp_path / "prepared", {"plan": "ü"}) as folder:
        (folder / "file").write_bytes(b"1")
    assert names_in(tmp_path) == ["a.json", "a.txt", "out", "out/file", "prepared", "prepared/file"]


def test_a_failure_with_an_open_file_is_reported_as_such(windows, tmp_path):
    opened = []
    with pytest.raises(ZeroDivisionError), whole_file(tmp_path / "a") as temporary:
        opened.append(open(temporary, "wb"))
        raise ZeroDivisionError
    opened[0].close()


def test_a_file_that_another_program_holds_is_named_in_one_line(windows, tmp_path):
    write_text(tmp_path / "a.txt", "before")
    with open(tmp_path / "a.txt", "rb"), pytest.raises(CannotWrite, match="Fix: Close other programs that use it"):
        write_text(tmp_path / "a.txt", "after")
    assert names_in(tmp_path) == ["a.txt"] and (tmp_path / "a.txt").read_bytes() == b"before"


def test_a_scanner_that_holds_a_new_file_for_a_moment_is_waited_for(windows, tmp_path, monkeypatch):
    real, calls = os.replace, []

    def busy(*paths):
        calls.append(paths)
        if len(calls) < 3:
            with open(paths[0], "rb"):
                real(*paths)
        real(*paths)

    monkeypatch.setattr(os, "replace", busy)
    write_text(tmp_path / "a.txt", "text")
    assert len(calls) == 3 and (tmp_path / "a.txt").read_bytes() == b"text"


def test_leftovers_are_found_without_ending_their_owner(windows, tmp_path):
    code = "import sys, pathlib; from endoprior.system.atomic import temporary_sibling as name\n"
    code += "name(pathlib.Path(sys.argv[1])).touch(); print(flush=True); input()"
    words = [sys.executable, "-P", "-c", code, str(tmp_path / "a.png")]
    with subprocess.Popen(words, stdin=subprocess.PIPE, stdout=subprocess.PIPE) as living:
        living.stdout.readline()
        remove_leftovers(tmp_path)
        assert len(names_in(tmp_path)) == 1 and living.poll() is None
        living.communicate(b"\n")
    remove_leftovers(tmp_path)
    assert names_in(tmp_path) == []


def test_arrays_do_not_keep_their_file_in_use(windows, tmp_path):
    path, arrays = tmp_path / "a.safetensors", {"a": torch.arange(5000.0)}
    save_arrays(path, arrays, {}, "test-1")
    loaded, _ = load_arrays(path, {"test-1": lambda about: {"a": ArraySpec("float32", (5000,))}}, "Write it again.")
    save_arrays(path, {"a": loaded["a"] + 1}, {}, "test-1")
    assert torch.equal(loaded["a"], arrays["a"])


def test_training_saves_and_resumes(windows, tiny_sequence, tmp_path):
    cfg, whole, parts = tiny_config("hexplane", coarse=2, fine=10), tmp_path / "whole", tmp_path / "parts"
    (tmp_path / "whole").mkdir()
    train(load_sequence(tiny_sequence), cfg, whole, checkpoint_seconds=0)

    def stop(report, trainer):
        if report.iteration == 4:
            raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        train(load_sequence(tiny_sequence), cfg, parts, checkpoint_seconds=0, on_step=stop)
    train(load_sequence(tiny_sequence), cfg, parts, checkpoint_seconds=0, resume=True)
    for name in ("scene.safetensors", "checkpoint.safetensors"):
        assert (parts / name).read_bytes() == (whole / name).read_bytes()
    demand_portable(tmp_path)


def test_a_run_that_cannot_begin_leaves_nothing(windows, tiny_sequence, tmp_path, monkeypatch):
    def fail(trainer):
        raise InputError("no points")

    monkeypatch.setattr("endoprior.training.gaussian_trainer.GaussianTrainer.start", fail)
    with pytest.raises(InputError, match="no points"):
        train(load_sequence(tiny_sequence), tiny_config("basis"), tmp_path / "run")
    assert not (tmp_path / "run" / "config.json").exists()


@pytest.mark.parametrize(
    ("name", "out"), [("ply", "ply"), ("tracks", "tracks"), ("depth", "depth"), ("html", "a.html"), ("video", "a.mp4")]
)
def test_exports_are_written(windows, tmp_path, name, out):
    scene = moving_scene()
    for _ in range(2 if Path(out).suffix else 1):  # a file is replaced
        export(
            scene, tmp_path / "Jörg" / out, ExportOptions(format=name, **({"grid_px": 8} if name == "tracks" else {}))
        )
    assert (tmp_path / "Jörg" / out).exists()
    demand_portable(tmp_path)


def test_prepare_and_check_write_in_a_folder_with_an_umlaut(windows, tmp_path, capsys):
    rng = np.random.default_rng(0)
    texture = np.kron(rng.integers(40, 200, (12, 16, 3), np.uint8), np.ones((8, 8, 1), np.uint8))
    video = write_video(tmp_path / "clip.mkv", [texture[i : i + 80, i : i + 96] for i in range(5)])
    out = tmp_path / "Jörg" / "data"
    cfg = PrepareConfig(border="keep", masks="none", depth="shading", poses="still")
    prepare(video, out, cfg)
    assert np.load(out / "poses_bounds.npy")[0, 15] > 0  # the nearest depth, read from the files
    assert main(["check", str(out), "--out", str(tmp_path / "check.png"), "--json", str(tmp_path / "check.json")]) == 0
    demand_portable(tmp_path)


def test_case_does_not_hide_that_a_path_lies_in_a_folder(tmp_path, capsys, monkeypatch):
    (tmp_path / "Data").mkdir()
    (tmp_path / "Data" / "check.png").touch()
    with case_is_ignored():
        assert lies_in(tmp_path / "data" / "check.png", tmp_path / "DATA")
        assert not lies_in(tmp_path / "other.png", tmp_path / "Data")
        monkeypatch.chdir(tmp_path / "Data")
        with pytest.raises(InputError, match="one that is in use"), whole_folder(tmp_path / "data"):
            pass
        words = ["check", str(tmp_path / "Data"), "--out", str(tmp_path / "data" / "check.png")]
        assert main(words) == 2 and "expected a path outside of" in capsys.readouterr().err
