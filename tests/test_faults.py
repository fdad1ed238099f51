"""Kills, full disks and closed terminals, in short; `make test-faults` has the long ones."""

from __future__ import annotations

import os
import resource
import signal
import sys
import threading
import time
from pathlib import Path

import numpy as np
import pytest
from tiny_training import tiny_config

from endoprior.core.checks import InputError
from endoprior.data import load_sequence
from endoprior.runs.folder import deferred_interrupt
from endoprior.runs.train import train
from endoprior.system import atomic
from endoprior.system.atomic import CannotWrite, whole_file, whole_folder
from endoprior.training.gaussian_trainer import GaussianTrainer
from endoprior.visualization import video
from endoprior.visualization.video import write_video

sys.path.insert(0, str(Path(__file__).parents[1] / "faults"))

from harness import Program, differences, leftovers, run

SHORT = [
    "--init-budget", "300", "--schedule.coarse-iterations", "5", "--schedule.fine-iterations", "250",
    "--density.start-iteration", "20", "--density.every", "20", "--no-networks",
]  # fmt: skip


def test_a_file_appears_whole_or_not_at_all(tmp_path):
    path = tmp_path / "new" / "file.txt"
    with whole_file(path) as temporary:
        temporary.touch(mode=0o600)
        temporary.write_text("first")
        assert not path.exists()
    (tmp_path / "b").touch()
    assert path.stat().st_mode == (tmp_path / "b").stat().st_mode, "the usual permissions"
    with pytest.raises(ZeroDivisionError), whole_file(path) as temporary:
        temporary.write_text("half")
        raise ZeroDivisionError
    assert path.read_text() == "first" and list(path.parent.iterdir()) == [path]


@pytest.mark.parametrize(
    ("error", "words"),
    [
        (OSError(27, "File too large"), "File too large"),
        (RuntimeError("I/O error: No space left on device (os error 28)"), "No space left"),  # of a library
    ],
)
def test_a_disk_that_refuses_is_named_with_its_reason(tmp_path, error, words):
    for whole in (whole_file, whole_folder):
        with pytest.raises(CannotWrite) as caught, whole(tmp_path / "out"):
            raise error
        text = str(caught.value)
        assert text.startswith(f"{tmp_path / 'out'}: expected") and words in text and "\n" not in text
        assert list(tmp_path.iterdir()) == []


def test_an_encoder_that_only_stops_is_asked_for_the_disk(tmp_path, monkeypatch):
    with pytest.raises(CannotWrite, match="an encoder that stopped"), whole_file(tmp_path / "film.mp4"):
        raise BrokenPipeError("the encoder stopped")
    monkeypatch.setattr(atomic, "FULL_BYTES", 1 << 62)
    with pytest.raises(CannotWrite, match="No space left"), whole_file(tmp_path / "film.mp4"):
        raise BrokenPipeError("the encoder stopped")


def test_an_unreadable_input_is_not_blamed_on_the_output(tmp_path):
    with pytest.raises(PermissionError), whole_folder(tmp_path / "a" / "out"):
        raise PermissionError(13, "Permission denied", str(tmp_path / "input.png"))


@pytest.mark.slow
def test_training_goes_on_after_kills_to_the_same_bytes(tiny_sequence, tmp_path):
    words, parts = ["train", tiny_sequence, tmp_path / "parts", *SHORT], tmp_path / "parts"
    assert run("train", tiny_sequence, tmp_path / "whole", *SHORT).status == 0
    for attempt in range(2):
        resume = ["--resume"] if (parts / "config.json").exists() else []
        program = Program(*words, "--checkpoint-seconds", "0.05", *resume)
        while program.running and not list(parts.glob(".checkpoint*.partial*")):  # strike while one is written
            time.sleep(0.0005)
        program.kill()
        assert program.wait().status == -9, f"ended before kill {attempt}"
    assert run(*words, "--resume").status == 0
    assert differences(parts, tmp_path / "whole") + leftovers(parts) == []


@pytest.mark.slow
def test_a_run_killed_before_its_first_checkpoint_starts_again(tiny_sequence, tmp_path):
    cfg, out = tiny_config("basis"), tmp_path / "run"
    whole = train(load_sequence(tiny_sequence), cfg, tmp_path / "whole")

    def stop(report, trainer):
        raise SystemExit  # nothing is saved

    with pytest.raises(SystemExit):
        train(load_sequence(tiny_sequence), cfg, out, on_step=stop)
    assert not (out / "checkpoint.safetensors").exists()
    with pytest.raises(InputError, match=r"config differs at seed"):
        train(load_sequence(tiny_sequence), tiny_config("basis").__class__(seed=5), out, resume=True)
    train(load_sequence(tiny_sequence), cfg, out, resume=True)
    assert differences(out, tmp_path / "whole") == [] and len(whole)


def test_a_run_killed_while_it_finds_its_first_points_starts_again(tiny_sequence, tmp_path, monkeypatch):
    def die(trainer):
        raise SystemExit

    with monkeypatch.context() as patched, pytest.raises(SystemExit):
        patched.setattr(GaussianTrainer, "start", die)
        train(load_sequence(tiny_sequence), tiny_config("basis"), tmp_path / "run")
    train(load_sequence(tiny_sequence), tiny_config("basis"), tmp_path / "run", resume=True)
    assert (tmp_path / "run" / "scene.safetensors").is_file()


@pytest.mark.parametrize("there", [True, False])
def test_a_run_that_cannot_begin_leaves_the_folder_as_it_was(tiny_sequence, tmp_path, monkeypatch, there):
    def refuse(trainer):
        raise InputError("no points")

    out = tmp_path / "run"
    if there:
        out.mkdir()
    monkeypatch.setattr(GaussianTrainer, "start", refuse)
    with pytest.raises(InputError):
        train(load_sequence(tiny_sequence), tiny_config("basis"), out)
    assert out.exists() == there and not (out / "config.json").exists()


def test_two_processes_do_not_train_in_one_folder(tiny_sequence, tmp_path):
    cfg, out = tiny_config("basis"), tmp_path / "run"
    refused = []

    def intrude(report, trainer):
        if not refused:
            with pytest.raises(InputError, match="no other process") as caught:
                train(load_sequence(tiny_sequence), cfg, out, resume=True)
            refused.append(caught)

    train(load_sequence(tiny_sequence), cfg, out, on_step=intrude)
    assert refused and not (out / ".lock").exists()


@pytest.mark.parametrize("name", ["SIGTERM", "SIGHUP"])
def test_schedulers_and_closing_terminals_are_heard(tiny_sequence, tmp_path, name):
    cfg, out, sent = tiny_config("basis"), tmp_path / "run", []
    # Under `nohup` the test would be told to ignore it.
    before = signal.signal(getattr(signal, name), signal.SIG_DFL)

    def end(report, trainer):
        if not sent:
            sent.append(signal.raise_signal(getattr(signal, name)))

    with pytest.raises(KeyboardInterrupt):
        train(load_sequence(tiny_sequence), cfg, out, on_step=end)
    signal.signal(getattr(signal, name), before)
    assert (out / "checkpoint.safetensors").is_file()
    train(load_sequence(tiny_sequence), cfg, out, resume=True)


def test_nohup_is_respected_and_a_second_ctrl_c_does_not_wait():
    before = signal.signal(signal.SIGHUP, signal.SIG_IGN)
    try:
        with deferred_interrupt() as pressed:
            signal.raise_signal(signal.SIGHUP)
            assert not pressed()
            signal.raise_signal(signal.SIGINT)
            assert pressed()
            with pytest.raises(KeyboardInterrupt):
                signal.raise_signal(signal.SIGINT)
        assert signal.getsignal(signal.SIGHUP) is signal.SIG_IGN
    finally:
        signal.signal(signal.SIGHUP, before)


def test_signals_are_left_alone_outside_the_main_thread():
    seen = []
    thread = threading.Thread(target=lambda: seen.append(deferred_interrupt().__enter__()()))
    thread.start()
    thread.join()
    assert seen == [False]


@pytest.mark.slow
def test_a_limit_for_files_stops_training_in_one_line_and_keeps_the_checkpoint(tiny_sequence, tmp_path):
    out = tmp_path / "run"
    words = ["train", tiny_sequence, out, *SHORT]
    assert run(*words).status == 0
    (out / "scene.safetensors").unlink()
    kept = (out / "checkpoint.safetensors").read_bytes()
    done = run(*words, "--resume", limits={resource.RLIMIT_FSIZE: 50_000})
    assert done.one_line and "File too large" in done.err, done.err
    assert (out / "checkpoint.safetensors").read_bytes() == kept and not leftovers(out)


def test_a_film_that_was_cut_short_is_noticed(tmp_path, monkeypatch):
    pictures = [np.full((33, 48, 3), 20 * i, np.uint8) for i in range(7)]
    write_video(tmp_path / "whole.mp4", pictures, 10.0)
    count = video.num_frames

    def cut_and_count(path):
        os.truncate(path, os.path.getsize(path) - 200)  # the last image is not complete
        return count(path)

    monkeypatch.setattr(video, "num_frames", cut_and_count)
    with pytest.raises(CannotWrite, match="an encoder that stopped"):
        write_video(tmp_path / "film.mp4", pictures, 10.0)
    assert [path.name for path in tmp_path.iterdir()] == ["whole.mp4"]
