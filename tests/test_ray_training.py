"""Trainings and batches on a Ray cluster: bit-identical to one process, also where a process is killed."""

from __future__ import annotations

import json
import os
import shutil
import signal
import subprocess
import sys
import time
from dataclasses import replace
from pathlib import Path

import cv2
import numpy as np
import pytest
import torch
from conftest import write_tiny_sequence
from ray_runs import in_windows, needs_ray, silent
from tiny_training import tiny_config

from endoprior.core.config import Config, DataConfig
from endoprior.core.config_io import to_dict
from endoprior.data import load_sequence
from endoprior.runs.remote import train_here, trainings
from endoprior.runs.train import start_run, train, window_config

SCENES = ("scene.safetensors", *(f"windows/{k:03d}/scene.safetensors" for k in range(3)))


def write_config(file: Path, cfg: Config) -> Path:
    file.write_text(json.dumps(to_dict(cfg)))
    return file


@pytest.mark.slow
def test_windows_trained_elsewhere_in_any_order_give_the_same_bits(make_tiny_sequence, tmp_path):
    data, cfg, whole, out = make_tiny_sequence(num_frames=20), in_windows(14), tmp_path / "whole", tmp_path / "run"
    train(load_sequence(data, cfg.data), cfg, whole)
    run = start_run(load_sequence(data, cfg.data), cfg, out, resume=False, say=silent)
    with run.opened():
        left = trainings(run, checkpoint_seconds=0)
        assert [each.name[:13] for each in left] == ["window 1 of 3", "window 2 of 3", "window 3 of 3"]
        for each in reversed(left):
            train_here(replace(each, threads=replace(each.threads, numba=1)))
            train_here(each)  # as after a worker that died when it was done
    assert not trainings(run)
    again = start_run(load_sequence(data, cfg.data), cfg, out, resume=True, say=silent)
    again.complete()
    for file in SCENES:
        assert (out / file).read_bytes() == (whole / file).read_bytes()


def test_a_window_of_a_part_is_counted_from_the_first_frame_of_the_folder():
    cfg = replace(in_windows(14), data=DataConfig(window="5-30"))
    assert window_config(cfg, 3, 9).data.window == "8-13"


# A real cluster of two processes.


@pytest.fixture(scope="module")
def trained(tmp_path_factory):
    """A sequence, its config in three windows, and its run in this process."""
    folder = tmp_path_factory.mktemp("ray")
    data, cfg = write_tiny_sequence(folder / "data", num_frames=20), in_windows(400)
    train(load_sequence(data, cfg.data), cfg, folder / "run")
    return data, write_config(folder / "config.json", cfg), folder / "run"


def begin(*words: object) -> subprocess.Popen:
    """Start the program, with as many threads of torch as here; in the background of a script, which ignores SIGINT."""
    command = [sys.executable, "-m", "endoprior", *map(str, words)]
    environment = os.environ | {"OMP_NUM_THREADS": str(torch.get_num_threads())}
    return subprocess.Popen(
        command,
        stdout=subprocess.PIPE,
        stderr=subprocess.STDOUT,
        text=True,
        env=environment,
        preexec_fn=lambda: signal.signal(signal.SIGINT, signal.SIG_IGN),
    )


def wait_for_checkpoints(process: subprocess.Popen, out: Path, *windows: int) -> None:
    while not all((out / f"windows/{k:03d}/checkpoint.safetensors").exists() for k in windows):
        assert process.poll() is None, process.stdout.read()
        time.sleep(0.05)


def process_training_in(folder: Path) -> int:
    """The process that has the log of a run open."""
    for process in Path("/proc").iterdir():
        try:
            if process.name.isdecimal() and any(
                os.readlink(fd).startswith(f"{folder}/") for fd in process.glob("fd/*")
            ):
                return int(process.name)
        except OSError:  # ended, or of another user
            continue
    raise AssertionError(f"nobody trains in {folder}")


@pytest.mark.slow
@needs_ray
def test_a_killed_worker_costs_its_window_only(trained, tmp_path):
    data, config, whole = trained
    out = tmp_path / "out"
    process = begin(
        "train", data, out, "--config", config, "--no-networks", "--ray", "local", "--checkpoint-seconds", 0
    )
    try:
        wait_for_checkpoints(process, out, 0, 1)
        victim = process_training_in(out / "windows/001")
        assert victim != process.pid
        os.kill(victim, signal.SIGKILL)
        said, _ = process.communicate(timeout=600)
    finally:
        process.kill()
    assert process.returncode == 0, said
    died = [line for line in said.splitlines() if "its process died" in line]
    assert len(died) == 1 and died[0].startswith("window 2 of 3: frames 5 to 14: its process died and is started again")
    assert said.count("trained in") == 3
    for file in SCENES:
        assert (out / file).read_bytes() == (whole / file).read_bytes()
    logged = [json.loads(line) for line in (out / "log.jsonl").read_text().splitlines()]
    assert [(line["window"], line["stage"], line["iteration"]) for line in logged] == [
        (line["window"], line["stage"], line["iteration"])
        for line in map(json.loads, (whole / "log.jsonl").read_text().splitlines())
    ]


@pytest.mark.slow
@needs_ray
def test_an_interrupted_cluster_saves_and_resumes_without_one(trained, tmp_path):
    data, config, whole = trained
    out = tmp_path / "out"
    process = begin(
        "train", data, out, "--config", config, "--no-networks", "--ray", "local", "--checkpoint-seconds", 0
    )
    try:
        wait_for_checkpoints(process, out, 0, 1)
        process.send_signal(signal.SIGINT)
        said, _ = process.communicate(timeout=600)
    finally:
        process.kill()
    assert process.returncode == 130 and "the state is saved" in said and "with --resume" in said
    assert not (out / "scene.safetensors").exists() and not list(out.rglob(".lock"))
    train(out=out, resume=True)
    for file in SCENES:
        assert (out / file).read_bytes() == (whole / file).read_bytes()


@pytest.mark.slow
@needs_ray
def test_a_batch_on_a_cluster(trained, tmp_path):
    data, cfgs = trained[0], {"three": in_windows(14), "one": tiny_config("basis")}
    for name, cfg in cfgs.items():
        write_config(tmp_path / f"{name}.json", cfg)
        train(load_sequence(data, cfg.data), cfg, tmp_path / name)
    no_depth = shutil.copytree(data, tmp_path / "no depth")
    for file in (no_depth / "depth").iterdir():
        cv2.imwrite(str(file), np.zeros((40, 48), np.uint16))
    listed = tmp_path / "list.txt"
    lines = [f"{name} = '{data}' --config '{tmp_path / name}.json'" for name in cfgs]
    listed.write_text("\n".join([*lines, f"'{no_depth}'"]))
    process = begin("batch", listed, tmp_path / "out", "--ray", "local")
    said, _ = process.communicate(timeout=300)
    assert process.returncode == 1, said
    for file in SCENES:
        assert (tmp_path / "out/three/run" / file).read_bytes() == (tmp_path / "three" / file).read_bytes()
    assert (tmp_path / "out/one/run" / SCENES[0]).read_bytes() == (tmp_path / "one" / SCENES[0]).read_bytes()
    summary = (tmp_path / "out/summary.md").read_text()
    assert "| three | " in summary and "| one | " in summary and "\n- no depth: " in summary
    assert all((tmp_path / "out/one" / name).exists() for name in ("report.png", "video.mp4", "player.html"))
