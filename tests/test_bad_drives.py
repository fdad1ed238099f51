"""Network drives without locks, or that are gone; signals; names with colons; data and logs that change or break."""

from __future__ import annotations

import errno
import os
import shutil
import signal
from pathlib import Path

import numpy as np
import pytest
from tiny_training import tiny_config

from endoprior.cli import main
from endoprior.cli.paths import require_writable_folder
from endoprior.core.checks import InputError
from endoprior.data import load_sequence
from endoprior.runs.log import read_log
from endoprior.runs.train import train
from endoprior.system.file_lock import exclusive, locked
from endoprior.system.signals import all_interrupt
from endoprior.visualization.video import num_frames, write_video

GONE = ("ESTALE", "ETIMEDOUT", "ENXIO", "EIO", "ENOTCONN")
NO_LOCKS = ("ENOSYS", "ENOTSUP", "ENOLCK", "EINVAL")
PICTURES = [np.full((32, 48, 3), 20 * i, np.uint8) for i in range(4)]


def without_flock(monkeypatch, name: str) -> None:
    """Make `flock` answer with this error."""
    import fcntl

    def refuse(*words):
        raise OSError(getattr(errno, name), os.strerror(getattr(errno, name)))

    monkeypatch.setattr(fcntl, "flock", refuse)


@pytest.mark.parametrize("name", NO_LOCKS)
def test_a_drive_without_locks_is_locked_by_a_file(tmp_path, monkeypatch, name):
    without_flock(monkeypatch, name)
    file = tmp_path / ".lock"
    with locked(tmp_path, file):
        assert str(os.getpid()) in file.read_text()
        with pytest.raises(InputError, match=r"no other process.*remove .*\.lock"), locked(tmp_path, file):
            pass
    with exclusive(file):
        pass
    assert list(tmp_path.iterdir()) == []


def test_without_flock_only_the_lock_of_a_dead_process_of_this_machine_is_free(tmp_path, monkeypatch):
    without_flock(monkeypatch, "ENOLCK")
    file = tmp_path / ".lock"
    with locked(tmp_path, file):
        owner = file.read_text().splitlines()
    dead = 2**22 - 3
    file.write_text("\n".join([str(dead), "another-machine", *owner[2:]]) + "\n")
    with pytest.raises(InputError, match="no other process"), locked(tmp_path, file):
        pass
    file.write_text("\n".join([str(dead), *owner[1:]]) + "\n")
    with locked(tmp_path, file):
        pass


@pytest.mark.slow
def test_a_training_works_without_flock(tiny_sequence, tmp_path, monkeypatch):
    without_flock(monkeypatch, "ENOLCK")
    cfg, out = tiny_config("basis", coarse=1, fine=2), tmp_path / "out"
    train(load_sequence(tiny_sequence), cfg, out)
    train(load_sequence(tiny_sequence), cfg, out, resume=True)
    assert not (out / ".lock").exists()


@pytest.mark.parametrize("name", GONE)
@pytest.mark.parametrize("is_named", [True, False])
def test_a_drive_that_is_gone_is_one_line(tiny_sequence, monkeypatch, capsys, name, is_named):
    def refuse(path, *words, **options):
        raise OSError(getattr(errno, name), os.strerror(getattr(errno, name)), *([str(path)] if is_named else []))

    for place, change in (
        ("pathlib.Path.iterdir", refuse),
        ("numpy.fromfile", refuse),
        ("endoprior.cli.check.Check.execute", lambda check: refuse(check.folder)),
    ):
        with monkeypatch.context() as patched:
            patched.setattr(place, change)
            assert main(["check", str(tiny_sequence)]) == 2
    lines = capsys.readouterr().err.splitlines()
    assert len(lines) == 3 and all(os.strerror(getattr(errno, name)) in line for line in lines)


def test_a_bug_stays_a_traceback(monkeypatch):
    def fail(check):
        raise OSError(errno.EBADF, "Bad file descriptor")

    monkeypatch.setattr("endoprior.cli.check.Check.execute", fail)
    with pytest.raises(OSError, match="Bad file"):
        main(["check", "data"])


@pytest.mark.parametrize("name", ["SIGTERM", "SIGHUP", "SIGINT"])
def test_a_signal_removes_partial_output(tmp_path, monkeypatch, capsys, name):
    number = getattr(signal, name)
    before = signal.signal(number, signal.SIG_DFL)
    save = np.save

    def stop(*words):
        save(*words)
        signal.raise_signal(number)
        if name != "SIGINT":  # closing terminals send it twice
            signal.raise_signal(number)

    monkeypatch.setattr(np, "save", stop)
    try:
        assert main(["phantom", str(tmp_path / "out"), "--frames", "2", "--width", "48", "--height", "40"]) == 130
    finally:
        assert signal.signal(number, before) == signal.SIG_DFL
    assert capsys.readouterr().err == "endoprior: interrupted\n" and list(tmp_path.iterdir()) == []


def test_a_repeated_signal_does_not_end_the_cleanup():
    with all_interrupt():
        with pytest.raises(KeyboardInterrupt):
            signal.raise_signal(signal.SIGTERM)
        signal.raise_signal(signal.SIGTERM)
        with pytest.raises(KeyboardInterrupt):
            signal.raise_signal(signal.SIGINT)


def test_a_signal_that_the_program_around_python_handles_stays_so(monkeypatch):
    set_by_us = []
    monkeypatch.setattr(signal, "getsignal", lambda _number: None)
    monkeypatch.setattr(signal, "signal", lambda number, _handler: set_by_us.append(number))
    with all_interrupt():
        pass
    assert set_by_us == []


@pytest.mark.parametrize("name", ["SIGTERM", "SIGHUP", "SIGINT"])
def test_a_signal_leaves_no_probe_of_a_folder(tmp_path, monkeypatch, name):
    touch = Path.touch

    def stop(path, *words, **options):
        touch(path, *words, **options)
        signal.raise_signal(getattr(signal, name))

    monkeypatch.setattr(Path, "touch", stop)
    before = signal.signal(getattr(signal, name), signal.SIG_DFL)  # `nohup` ignores SIGHUP, and the program with it
    try:
        with all_interrupt(), pytest.raises(KeyboardInterrupt):
            require_writable_folder("OUT", tmp_path / "out")
    finally:
        signal.signal(getattr(signal, name), before)
    assert list(tmp_path.iterdir()) == []


def test_names_with_colons_are_written(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    file = Path("2026-01-05T10:30:00.mp4")
    write_video(file, PICTURES, 10.0)
    assert num_frames(file) == len(PICTURES) and [path.name for path in tmp_path.iterdir()] == [file.name]


def test_a_log_is_read_without_a_line_that_was_cut(tmp_path):
    log = tmp_path / "log.jsonl"
    log.write_bytes(b'{"stage": "fine"}\n{"stage": "fi\xff\0\0')
    assert read_log(log, "stage") == [{"stage": "fine"}]
    for broken in (b'{"stage": "fi', b"[]", b'{"step": 1}', b"[" * 100_000):
        log.write_bytes(broken + b'\n{"stage": "fine"}\n')
        with pytest.raises(InputError, match=r"log.jsonl, line 1: expected an iteration"):
            read_log(log, "stage")


def test_data_that_is_replaced_during_training_stops_it(tiny_sequence, tmp_path):
    cfg, out, kept = tiny_config("basis"), tmp_path / "run", []
    images = sorted((tiny_sequence / "images").iterdir())

    def replace_data(report, trainer):
        if report.iteration == 1:
            for image in images:  # a backup that touches files changes nothing
                image.touch()
        elif report.iteration == 4:
            kept.append((out / "checkpoint.safetensors").read_bytes())
            shutil.copy(images[3], images[0])

    with pytest.raises(InputError, match=rf"{images[0].name}: expected data that stays as it is"):
        train(load_sequence(tiny_sequence), cfg, out, checkpoint_seconds=0, on_step=replace_data)
    assert (out / "checkpoint.safetensors").read_bytes() == kept[0] and not (out / "scene.safetensors").exists()
    with pytest.raises(InputError, match="other data"):
        train(load_sequence(tiny_sequence), cfg, out, resume=True)


def test_data_that_is_replaced_before_training_begins_stops_it(tiny_sequence, tmp_path):
    sequence = load_sequence(tiny_sequence)
    (tiny_sequence / "poses_bounds.npy").touch()
    with pytest.raises(InputError, match=r"poses_bounds.npy: expected data that stays"):
        train(sequence, tiny_config("basis"), tmp_path / "run")
    assert not (tmp_path / "run").exists()
