"""Event files of a training say what its log says, once, also after a resume."""

import builtins
import json

import numpy as np
import pytest
from tiny_training import tiny_config

from endoprior.cli import main
from endoprior.core.checks import InputError
from endoprior.runs.log import EVENTS, EventFiles, read_log
from endoprior.runs.train import train


def shown(folder):
    """Steps and values by name, read by TensorBoard itself."""
    pytest.importorskip("tensorboard")
    from tensorboard.backend.event_processing.event_accumulator import EventAccumulator

    events = EventAccumulator(str(folder))
    events.Reload()
    names = events.Tags()
    scalars = {name: [(each.step, each.value) for each in events.Scalars(name)] for name in names["scalars"]}
    return scalars, {name: [each.step for each in events.Images(name)] for name in names["images"]}


def test_values_are_those_of_the_log_and_a_resumed_run_shows_them_once(tiny_sequence, tmp_path):
    pytest.importorskip("tensorboard")
    run, cfg = tmp_path / "run", tiny_config("basis", coarse=20, fine=30)
    from endoprior.data import load_sequence

    sequence = load_sequence(tiny_sequence, cfg.data)

    def stop(report, _trainer):
        if report.iteration == 15 and report.stage.name == "FINE":
            raise KeyboardInterrupt

    events = EventFiles(run)
    with pytest.raises(KeyboardInterrupt):
        train(sequence, cfg, run, on_step=lambda *words: (events(*words), stop(*words)), checkpoint_seconds=1e9)
    events = EventFiles(run)
    train(sequence, cfg, run, resume=True, on_step=events)
    events.finish({"psnr": 30.0}, 50)
    assert len(list(run.glob(EVENTS))) == 1
    scalars, _ = shown(run)
    lines = read_log(run / "log.jsonl")
    steps = [line["iteration"] + 20 * (line["stage"] == "fine") for line in lines]
    assert [step for step, _ in scalars["loss"]] == steps == sorted(set(steps))
    np.testing.assert_allclose(
        [value for _, value in scalars["loss/color"]], [line["terms"]["color"] for line in lines], rtol=1e-6
    )
    assert [value for _, value in scalars["Gaussians"]] == [line["num_gaussians"] for line in lines]
    assert scalars["held-out frames/psnr"] == [(50, 30.0)]


def test_lines_that_are_shown_are_not_read_again(tmp_path):
    """A training of 30,000 iterations took half an hour longer for that."""
    pytest.importorskip("tensorboard")
    log, events = tmp_path / "log.jsonl", EventFiles(tmp_path)
    log.write_text(json.dumps({"stage": "fine", "iteration": 10, "terms": {"color": 0.5}}) + "\n")
    assert events.follow() == (tmp_path, 10)
    log.write_text("shown before\n" + json.dumps({"stage": "fine", "iteration": 20, "terms": {"color": 0.4}}) + "\n")
    assert events.follow() == (tmp_path, 20) and events.follow() is None
    with open(log, "a") as file:
        file.write("broken\n{}\n")
    with pytest.raises(InputError, match=r"log\.jsonl, line 3: expected an iteration as JSON, got 'broken'"):
        events.follow()


def test_the_command_writes_them_and_each_window_has_its_own(make_tiny_sequence, tmp_path, capsys):
    pytest.importorskip("tensorboard")
    data, run = make_tiny_sequence("long", num_frames=20), tmp_path / "run"
    words = ["train", str(data), str(run), "--tensorboard", "--no-networks", "--gaussians", "200"]
    assert main([*words, "--iterations", "100", "--windows.longest", "12"]) == 0
    windows = sorted((run / "windows").iterdir())
    assert len(windows) == 2
    for window in windows:
        scalars, images = shown(window)
        assert [step for step, _ in scalars["loss"]][-1] == 100 and images == {"first training frame": [100]}
    scores = json.loads((run / "metrics.json").read_text())["scores"]
    value = shown(run)[0]["held-out frames/psnr_tissue"]
    assert value == [(100, pytest.approx(scores["psnr_tissue"], rel=1e-6))]


def test_without_the_package_nothing_begins_and_one_line_says_how_to_install_it(tmp_path, monkeypatch):
    real = builtins.__import__

    def without(name, *words, **more):
        if name.startswith("torch.utils.tensorboard"):
            raise ModuleNotFoundError("No module named 'tensorboard'", name="tensorboard")
        return real(name, *words, **more)

    monkeypatch.setattr(builtins, "__import__", without)
    with pytest.raises(
        InputError, match=r"--tensorboard: tensorboard is not installed. Fix: `pip install .*tensorboard"
    ):
        EventFiles(tmp_path)
    assert list(tmp_path.iterdir()) == []
