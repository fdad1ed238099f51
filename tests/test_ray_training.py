"""Trainings and batches on a Ray cluster: bit-identical to one process, also where a process is killed."""

from __future__ import annotations

import importlib.util
import json
import os
import shutil
import signal
import socket
import subprocess
import sys
import time
from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace

import cv2
import numpy as np
import pytest
import torch
from conftest import write_tiny_sequence
from tiny_training import tiny_config

from endoprior.cli import main
from endoprior.cli.batch_list import entries_of, read_list
from endoprior.core.checks import InputError
from endoprior.core.config import Config, DataConfig
from endoprior.core.config_io import to_dict
from endoprior.core.config_windows import WindowConfig
from endoprior.data import load_sequence
from endoprior.pipeline import Entry, SequenceJob, run_here, run_on, write_summary
from endoprior.pipeline.steps import Step
from endoprior.runs.remote import Trained, train_here, trainings
from endoprior.runs.train import start_run, train
from endoprior.runs.windowed_run import window_config
from endoprior.system.ray_cluster import Cluster, Ended
from endoprior.system.threads import Threads

needs_ray = pytest.mark.skipif(
    importlib.util.find_spec("ray") is None or sys.platform != "linux", reason="no Ray, or not Linux"
)
SCENES = ("scene.safetensors", *(f"windows/{k:03d}/scene.safetensors" for k in range(3)))


def in_windows(fine: int) -> Config:
    windows = WindowConfig(enabled=True, shortest=6, longest=10, overlap=3)
    return replace(tiny_config("basis", fine=fine), windows=windows)


def write_config(file: Path, cfg: Config) -> Path:
    file.write_text(json.dumps(to_dict(cfg)))
    return file


def silent(text: str) -> None:
    """No lines."""


# The parts, without a cluster.


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


class FakeRay:
    """Ray in this process: calls happen in `wait`, and the processes of the calls `dies` die."""

    class RayError(Exception):
        """An error of the cluster."""

    class RayTaskError(RayError):
        """An error of a function."""

    exceptions = SimpleNamespace(RayError=RayError, RayTaskError=RayTaskError)

    def __init__(self, cores: list[int], dies: list[int] = ()) -> None:
        self.cores, self.dies, self.calls = cores, list(dies), 0

    def nodes(self):
        return [{"Alive": True, "Resources": {"CPU": float(cores)}} for cores in self.cores]

    def cluster_resources(self):
        return {}

    def remote(self, **options):
        return lambda function: SimpleNamespace(remote=lambda *arguments: (self._count(), function, arguments))

    def _count(self) -> int:
        self.calls += 1
        return self.calls

    def wait(self, references, num_returns):
        return references[:1], references[1:]

    def get(self, reference):
        number, function, arguments = reference
        if number in self.dies:
            raise self.RayError("\nThe worker died. Perhaps.\nMore about it.")
        try:
            return function(*arguments)
        except Exception as error:
            raised = self.RayTaskError("a traceback")
            raised.cause = error
            raise raised from None


def test_a_call_is_repeated_where_its_process_dies():
    said = []
    cluster = Cluster(FakeRay([2], dies=[1, 3]), said.append)
    cluster.start("a", divmod, 7, 2, restarts=2)
    cluster.start("b", divmod, 1, 0)
    assert cluster.num_running == 2
    ended = [cluster.next(), cluster.next()]
    assert [each.key for each in ended] == ["b", "a"] and ended[1].value == (3, 1) and cluster.num_running == 0
    assert isinstance(ended[0].error, ZeroDivisionError) and "a traceback" in str(ended[0].error.__cause__)
    assert said == ["a: its process died and is started again (The worker died)"] * 2
    cluster.start("c", divmod, 7, 2)
    cluster = Cluster(FakeRay([2], dies=[1, 2]), said.append)
    cluster.start("c", divmod, 7, 2, restarts=1)
    assert "The worker died" in str(cluster.next().error)


@pytest.mark.parametrize(("machines", "calls", "cores"), [([2], 1, 2), ([2], 3, 1), ([8, 4], 2, 4), ([0, 8], 3, 2)])
def test_cores_of_each_call(machines, calls, cores):
    assert Cluster(FakeRay(machines), silent).cores_for(calls) == cores


def test_what_no_machine_has_is_named():
    with pytest.raises(InputError, match="expected a machine with 3 cores, got at most 2"):
        Cluster(FakeRay([2]), silent).start("a", divmod, 7, 2, cores=3)
    with pytest.raises(InputError, match="expected a cluster with a GPU, got none"):
        Cluster(FakeRay([2]), silent).start("a", divmod, 7, 2, on_gpu=True)


def entry(name: str, out: Path) -> Entry:
    return Entry(name, SequenceJob(Path(name), out / name, tiny_config("basis"), {}))


@pytest.fixture
def fake_steps(monkeypatch):
    """Two steps that write a file; the second fails with what `fails` has under the name of the job."""
    fails: dict[str, Exception] = {}

    def act(job, progress):
        if job.out.name in fails:
            raise fails[job.out.name]
        (job.run / "metrics.json").write_text('{"scores": {"psnr_tissue": 30.25, "odd": 1}}')
        return []

    def first(job, progress):
        job.run.mkdir(parents=True)
        return []

    steps = (Step("first", lambda job: job.run, first), Step("train", lambda job: job.run / "metrics.json", act))
    for module in ("batch.steps_of", "batch.open_folder"):
        monkeypatch.setattr(f"endoprior.pipeline.{module}", lambda job: steps)
    monkeypatch.setattr("endoprior.pipeline.summary.load_sequence", lambda *_: SimpleNamespace(depth_is_relative=False))
    return fails


class Shown:
    """A context manager for the progress of a step; lists what was shown."""

    def __init__(self) -> None:
        self.steps = []

    def __call__(self, entry, step):
        self.steps.append(f"{entry.name} {step}")
        return self

    def __enter__(self):
        return silent

    def __exit__(self, *error):
        """Nothing to end."""


def test_a_failed_job_does_not_stop_the_others_and_is_tried_again(fake_steps, tmp_path):
    entries, shown = [entry(name, tmp_path) for name in "abc"], Shown()
    fake_steps |= {"a": InputError("no\ndepth"), "b": KeyError("bug")}
    outcomes = list(run_here(entries, shown))
    reasons = ["no depth", f"KeyError: 'bug' ({tmp_path / 'b' / 'failure.txt'})", ""]
    assert [outcome.failure for outcome in outcomes] == reasons
    assert "Traceback" in (tmp_path / "b/failure.txt").read_text() and not (tmp_path / "a/failure.txt").exists()
    lines = write_summary(outcomes, tmp_path)
    assert lines[2] == "| c | 30.25 dB |" and lines[-2:] == [f"- {n}: {r}" for n, r in zip("ab", reasons, strict=False)]
    assert (tmp_path / "scores.csv").read_text() == "name,psnr_tissue,odd\nc,30.25,1\n"
    fake_steps.clear()
    shown.steps.clear()
    assert not any(outcome.failure for outcome in run_here(entries, shown))
    assert shown.steps == ["a train", "b train"] and not (tmp_path / "b/failure.txt").exists()


class FakeCluster:
    """Answers each call with the value or error of its name in `answers`."""

    def __init__(self, answers: dict[str, object]) -> None:
        self.answers, self.calls, self.started = answers, [], []

    num_running = property(lambda self: len(self.calls))

    def cores_for(self, num_calls):
        return 1

    def start(self, key, *arguments, **options):
        self.started.append(str(key))
        self.calls.append(key)

    def next(self):
        key = self.calls.pop(0)
        answer = self.answers.get(str(key))
        return Ended(key, error=answer) if isinstance(answer, Exception) else Ended(key, answer)


def test_windows_of_all_jobs_train_at_the_same_time(fake_steps, tmp_path):
    from endoprior.runs.remote import Training

    windows = [Training(f"w{k}", tmp_path, tiny_config("basis"), tmp_path, False, Threads(1, 1)) for k in (1, 2)]
    answers = {"a: before training": windows, "b: before training": windows[:1], "c: before training": InputError("c")}
    answers |= {f"{name}: w{k}": Trained(9, 1.0, ()) for name in "ab" for k in (1, 2)}
    cluster = FakeCluster(answers | {"b: w1": InputError("diverged")})
    outcomes = list(run_on(cluster, [entry(name, tmp_path) for name in "abc"], silent))
    assert cluster.started[3:] == ["a: w1", "a: w2", "b: w1", "a: after training"]
    assert [(outcome.entry.name, outcome.failure) for outcome in outcomes] == [("c", "c"), ("b", "diverged"), ("a", "")]


# The list of a batch.


def test_lines_of_a_list(tmp_path, make_tiny_sequence):
    data = make_tiny_sequence("a b")
    file = tmp_path / "list.txt"
    file.write_text(f"# all\n\n'{data}' --preset paper # one\nx2 = '{data}' --seed 3 --optim.means-lr=1e-3\n")
    assert [(line.number, line.name, line.options) for line in read_list(file)] == [
        (3, "a b", ("--preset", "paper")),
        (4, "x2", ("--seed", "3", "--optim.means-lr=1e-3")),
    ]
    first, second = entries_of(file, tmp_path / "out", silent)
    assert first.job.out == tmp_path / "out/a b" and second.job.cfg.seed == 3 and second.job.cfg.optim.means_lr == 1e-3
    assert second.job.options == {"--seed": ("3",), "--optim.means-lr": ("1e-3",)}
    assert not (tmp_path / "out").exists()


@pytest.mark.parametrize(
    ("text", "said"),
    [
        (None, "expected a list of videos and sequence folders, got No such file"),
        ("# nothing\n", "expected a list of videos and sequence folders, got an empty file"),
        ("DATA\n\nabsent.mp4\n", "line 3: absent.mp4: expected a video or a sequence folder, got nothing"),
        ("DATA\nDATA\n", "line 2: expected another name, got 'tiny' in line 1, too. Fix: `NAME = "),
        ("../x = DATA\n", "line 1: expected a name for a folder"),
        ("x =\n", "line 1: expected a path, got none"),
        ("--seed 3\n", "line 1: expected a path, got --seed"),
        ("'DATA\n", "line 1: expected words as in a shell, got No closing quotation"),
        ("DATA --resume\n", "line 1: --resume: expected options of what to train"),
        ("DATA --sed 3\n", "line 1: endoprior train"),
        ("DATA --end 3\n", "line 1: endoprior train"),
    ],
)
def test_a_list_that_cannot_be_used(text, said, tiny_sequence, tmp_path, capsys):
    file, out = tmp_path / "list.txt", tmp_path / "out"
    if text is not None:
        file.write_text(text.replace("DATA", str(tiny_sequence)))
    assert main(["batch", str(file), str(out)]) == 2
    error = capsys.readouterr().err
    assert said in error and str(file) in error and error.count("\n") == 1 and not out.exists()


@pytest.fixture
def silent_address():
    """A port of this machine at which nothing listens."""
    with socket.socket() as taken:
        taken.bind(("127.0.0.1", 0))
        yield f"127.0.0.1:{taken.getsockname()[1]}"


@needs_ray
@pytest.mark.parametrize("scheme", ["", "ray://"])
def test_no_cluster_at_an_address(scheme, silent_address, tiny_sequence, tmp_path, capsys):
    (tmp_path / "list.txt").write_text(str(tiny_sequence))
    for words in (["train", str(tiny_sequence)], ["batch", str(tmp_path / "list.txt")]):
        began, out = time.monotonic(), tmp_path / "out"
        assert main([*words, str(out), "--ray", scheme + silent_address]) == 2
        error = capsys.readouterr().err
        assert "expected a running cluster, got" in error and error.count("\n") == 1 and not out.exists()
        assert time.monotonic() - began < 60


def test_ray_that_is_not_installed(tiny_sequence, tmp_path, capsys, monkeypatch):
    monkeypatch.setitem(sys.modules, "ray", None)
    assert main(["train", str(tiny_sequence), str(tmp_path / "out"), "--ray", "local"]) == 2
    assert "--ray: expected Ray, got none. Fix: `pip install" in capsys.readouterr().err
    assert not (tmp_path / "out").exists()


def test_a_live_view_needs_a_training_in_this_process(tiny_sequence, tmp_path, capsys):
    assert main(["train", str(tiny_sequence), str(tmp_path / "out"), "--ray", "local", "--view"]) == 2
    assert "--view: expected a training in this process" in capsys.readouterr().err


# A real cluster of two processes.


@pytest.fixture(scope="module")
def trained(tmp_path_factory):
    """A sequence, its config in three windows, and its run in this process."""
    folder = tmp_path_factory.mktemp("ray")
    data, cfg = write_tiny_sequence(folder / "data", num_frames=20), in_windows(400)
    train(load_sequence(data, cfg.data), cfg, folder / "run")
    return data, write_config(folder / "config.json", cfg), folder / "run"


def begin(*words: object) -> subprocess.Popen:
    """Start the program, with as many threads of torch as here."""
    command = [sys.executable, "-m", "endoprior", *map(str, words)]
    environment = os.environ | {"OMP_NUM_THREADS": str(torch.get_num_threads())}
    return subprocess.Popen(command, stdout=subprocess.PIPE, stderr=subprocess.STDOUT, text=True, env=environment)


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
        said, _ = process.communicate(timeout=180)
    finally:
        process.kill()
    assert process.returncode == 0, said
    died = [line for line in said.splitlines() if "its process died" in line]
    assert len(died) == 1 and died[0].startswith("window 2 of 3: frames 7 to 16: its process died and is started again")
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
        said, _ = process.communicate(timeout=180)
    finally:
        process.kill()
    assert process.returncode == 130 and "the state is saved" in said and "--ray local`" in said
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
