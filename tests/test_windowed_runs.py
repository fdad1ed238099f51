"""Runs of several windows: each is a run of its own; resumed, extended, trained by other processes, bit by bit."""

from __future__ import annotations

import json
import shutil
from dataclasses import replace
from pathlib import Path

import pytest
import torch
from tiny_training import tiny_config

from endoprior.core.checks import InputError
from endoprior.core.config import Config, DataConfig, WindowConfig
from endoprior.data import load_sequence
from endoprior.model.scene import Scene
from endoprior.model.scene_file import load_scene
from endoprior.model.windowed_scene import window_file
from endoprior.runs.remote import train_here, trainings
from endoprior.runs.train import WindowedRun, start_run, train


def in_windows(cfg: Config) -> Config:
    return replace(cfg, windows=WindowConfig(longest=10))


@pytest.fixture(scope="module")
def trained(tmp_path_factory) -> tuple[Path, Path]:
    """A sequence of 20 frames, and its run in three windows."""
    from conftest import write_tiny_sequence

    folder = tmp_path_factory.mktemp("windows")
    data = write_tiny_sequence(folder / "data", num_frames=20)
    train(load_sequence(data), in_windows(tiny_config("basis")), folder / "run")
    return data, folder / "run"


def test_every_window_is_a_run_of_its_own(trained, tmp_path):
    data, run = trained
    plan = json.loads((run / "config.json").read_text())["windows"]
    assert plan == [[0, 10], [5, 15], [10, 20]]
    cfg = tiny_config("basis")
    alone = replace(cfg, data=replace(cfg.data, window="5-14"))
    train(load_sequence(data, DataConfig(window="5-14")), alone, tmp_path / "alone")
    second = window_file(run / "scene.safetensors", 1)
    assert second.read_bytes() == (tmp_path / "alone/scene.safetensors").read_bytes()
    lines = [json.loads(line) for line in (run / "log.jsonl").read_text().splitlines()]
    assert {line["window"] for line in lines} == {0, 1, 2}


def test_in_memory_gives_the_same_scene(trained):
    data, run = trained
    scene, kept = train(load_sequence(data), in_windows(tiny_config("basis"))), load_scene(run)
    for frame in range(20):
        assert torch.equal(scene.render(frame / 20).color, kept.render(frame / 20).color)


def test_resuming_gives_the_bits_of_an_uninterrupted_run(trained, tmp_path):
    data, run = trained
    cfg, out, seen = in_windows(tiny_config("basis")), tmp_path / "run", []

    def stop(report, trainer):
        seen.append(report.iteration)
        if len(seen) == 27:  # in the middle of the second window
            raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        start_run(load_sequence(data), cfg, out, say=lambda text: None).complete(stop, checkpoint_seconds=0)
    assert not (out / "scene.safetensors").exists() and (out / "windows/000/scene.safetensors").exists()
    train(load_sequence(data), cfg, out, resume=True)
    for file in ("scene.safetensors", *(f"windows/{k:03d}/scene.safetensors" for k in range(3))):
        assert (out / file).read_bytes() == (run / file).read_bytes()


@pytest.mark.parametrize("killed_after", [5, 12])  # in the first window that goes on, and in the second one
def test_every_window_is_extended(trained, tmp_path, killed_after):
    data, run = trained
    cfg, seen = in_windows(tiny_config("basis")).extended(30), []
    sequence = load_sequence(data)

    def kill(report, trainer):
        seen.append(report.iteration)
        if len(seen) == killed_after:
            raise RuntimeError("killed")

    once, parts = (Path(shutil.copytree(run, tmp_path / name)) for name in ("once", "parts"))
    started = start_run(sequence, cfg, once, resume=True, extends=True, say=lambda text: None)
    started.complete()
    second = start_run(sequence, cfg, parts, resume=True, extends=True, say=lambda text: None)
    with pytest.raises(RuntimeError, match="killed"):
        second.complete(kill)
    assert seen[0] == 15 and not (parts / "scene.safetensors").exists()
    train(out=parts, resume=True)
    for file in ("scene.safetensors", *(f"windows/{k:03d}/scene.safetensors" for k in range(3))):
        assert (parts / file).read_bytes() == (once / file).read_bytes() != (run / file).read_bytes()
    last = [json.loads(line) for line in (once / "log.jsonl").read_text().splitlines()][-1]
    assert (last["window"], last["iteration"]) == (2, 20)
    with pytest.raises(InputError, match="more than the 30 of 30 iterations"):
        start_run(sequence, cfg, once, resume=True, extends=True, say=lambda text: None)


def test_another_process_extends_every_window(trained, tmp_path):
    data, run = trained
    cfg, sequence = in_windows(tiny_config("basis")).extended(30), load_sequence(data)
    once, parts = (Path(shutil.copytree(run, tmp_path / name)) for name in ("once", "parts"))
    here, elsewhere = (
        start_run(sequence, cfg, out, resume=True, extends=True, say=lambda text: None) for out in (once, parts)
    )
    here.complete()
    assert isinstance(elsewhere, WindowedRun)
    with elsewhere.opened() as out:
        for training in trainings(elsewhere):
            train_here(training)
        elsewhere.join(out)
    assert (parts / "windows/002/scene.safetensors").read_bytes() == (
        once / "windows/002/scene.safetensors"
    ).read_bytes()


def test_other_data_or_another_config_do_not_resume(trained, make_tiny_sequence):
    data, run = trained
    with pytest.raises(InputError, match="config differs"):
        train(load_sequence(data), replace(in_windows(tiny_config("basis")), seed=3), run, resume=True)
    other = make_tiny_sequence("other", num_frames=21)
    with pytest.raises(InputError, match="was trained on other data"):
        train(load_sequence(other), in_windows(tiny_config("basis")), run, resume=True)


def test_a_scene_of_windows_is_a_scene(trained):
    scene = load_scene(trained[1])
    assert isinstance(scene, Scene)
    with pytest.raises(ValueError, match=r"time must be in \[0, 1\]"):
        scene.at(1.1)
    assert scene.to("cpu").render(1.0).color.shape == (40, 48, 3)
