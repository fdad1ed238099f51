"""Batches: one failure does not stop the others, windows of all jobs train at once, and the list of jobs."""

from __future__ import annotations

from pathlib import Path
from types import SimpleNamespace

import pytest
from ray_runs import silent
from tiny_training import tiny_config

from endoprior.cli import main
from endoprior.cli.batch import entries_of
from endoprior.core.checks import InputError
from endoprior.model.presets import preset
from endoprior.pipeline import Entry, SequenceJob, run_here, run_on, write_summary
from endoprior.pipeline.steps import Step
from endoprior.runs.remote import Trained, Training
from endoprior.system.devices import Threads
from endoprior.system.ray_cluster import Ended

METRICS = '{"scores": {"psnr_tissue": 30.25, "odd": 1}, "verdict": {"word": "usable", "reasons": ["30 dB"]}}'


def entry(name: str, out: Path) -> Entry:
    return Entry(name, SequenceJob(Path(name), out / name, tiny_config("basis")))


@pytest.fixture
def fake_steps(monkeypatch):
    """Two steps that write a file; the second fails with what `fails` has under the name of the job."""
    fails: dict[str, Exception] = {}

    def act(job, _progress, _handed_on):
        if job.out.name in fails:
            raise fails[job.out.name]
        (job.run / "metrics.json").write_text(METRICS)
        return []

    def first(job, _progress, _handed_on):
        job.run.mkdir(parents=True)
        return []

    steps = (Step("first", lambda job: job.run, first), Step("train", lambda job: job.run / "metrics.json", act))
    for module in ("batch.steps_of", "batch.open_folder"):
        monkeypatch.setattr(f"endoprior.pipeline.{module}", lambda job: steps)
    monkeypatch.setattr("endoprior.pipeline.batch.load_sequence", lambda *_: SimpleNamespace(depth_is_relative=False))
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
    assert lines[2] == "| c | usable | 30.25 dB |"
    assert lines[-2:] == [f"- {n}: {r}" for n, r in zip("ab", reasons, strict=False)]
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


def test_a_job_without_a_folder_does_not_stop_the_others(fake_steps, tmp_path, monkeypatch):
    def opened(job):
        if job.out.name == "a":
            raise OSError("a name that is too long")

    monkeypatch.setattr("endoprior.pipeline.batch.open_folder", opened)
    (tmp_path / "a").write_text("")  # so that there is no place for the traceback either
    entries = [entry(name, tmp_path) for name in "ab"]
    assert [outcome.failure for outcome in run_here(entries, Shown())] == ["OSError: a name that is too long", ""]
    cluster = FakeCluster({"b: before training": []})
    assert [outcome.entry.name for outcome in run_on(cluster, entries, silent) if outcome.failure] == ["a"]


def test_windows_of_all_jobs_train_at_the_same_time(fake_steps, tmp_path):
    windows = [Training(f"w{k}", tmp_path, tiny_config("basis"), tmp_path, False, Threads(1, 1)) for k in (1, 2)]
    answers = {"a: before training": windows, "b: before training": windows[:1], "c: before training": InputError("c")}
    answers |= {f"{name}: w{k}": Trained(9, 1.0, ()) for name in "ab" for k in (1, 2)}
    cluster = FakeCluster(answers | {"b: w1": InputError("diverged")})
    outcomes = list(run_on(cluster, [entry(name, tmp_path) for name in "abc"], silent))
    assert cluster.started[3:] == ["a: w1", "a: w2", "b: w1", "a: after training"]
    assert [(outcome.entry.name, outcome.failure) for outcome in outcomes] == [("c", "c"), ("b", "diverged"), ("a", "")]


def test_lines_of_a_list(tmp_path, make_tiny_sequence):
    data = make_tiny_sequence("a b")
    file = tmp_path / "list.txt"
    file.write_text(f"# all\n\n'{data}' --preset paper # one\nx2 = '{data}' --seed 3 --optim.means-lr=1e-3\n")
    first, second = entries_of(file, tmp_path / "out", silent)
    assert (first.name, first.job.out, first.job.cfg) == ("a b", tmp_path / "out/a b", preset("paper"))
    assert (second.name, second.job.cfg.seed, second.job.cfg.optim.means_lr) == ("x2", 3, 1e-3)
    assert not (tmp_path / "out").exists()


@pytest.mark.parametrize(
    ("text", "said"),
    [
        (None, "expected a list of videos and sequence folders, got No such file"),
        ("# nothing\n", "expected a list of videos and sequence folders, got an empty file"),
        ("DATA\n\nabsent.mp4\n", "line 3: absent.mp4: expected a video or a sequence folder, got nothing"),
        ("DATA\nDATA\n", "line 2: NAME: expected another one, got 'tiny' in line 1, too. Fix: `NAME = "),
        ("../x = DATA\n", "line 1: NAME: expected a name for a folder"),
        ("x =\n", "line 1: PATH: expected a video or a folder, got none"),
        ("--seed 3\n", "line 1: PATH: expected a video or a folder, got --seed"),
        ("'DATA\n", "line 1: expected words as in a shell, got No closing quotation"),
        ("DATA --resume\n", "line 1: --resume: expected options of what to train"),
        ("DATA --sed 3\n", "line 1: endoprior train"),
        ("DATA --end 3\n", "line 1: endoprior train"),
        ("DATA --preset endonerf\n", "line 1: --preset: expected a method with Gaussians"),
    ],
)
def test_a_list_that_cannot_be_used(text, said, tiny_sequence, tmp_path, capsys):
    file, out = tmp_path / "list.txt", tmp_path / "out"
    if text is not None:
        file.write_text(text.replace("DATA", str(tiny_sequence)))
    assert main(["batch", str(file), str(out)]) == 2
    error = capsys.readouterr().err
    assert said in error and str(file) in error and error.count("\n") == 1 and not out.exists()
