"""The whole command: cells in processes, what is kept, what a failure or an interruption leaves, the report."""

from __future__ import annotations

import importlib.util
import json
import os
import signal
import subprocess
import sys
import time
from pathlib import Path

import cv2
import pytest
import yaml
from conftest import write_tiny_sequence

from endoprior.cli import main

TINY = {
    "schedule.fine_iterations": 12,
    "schedule.coarse_iterations": 0,
    "init.budget": 300,
    "init.motion": "rest",
    "density.start_iteration": 3,
    "density.every": 4,
}
METHODS = {"a": {"set": {"init.sampler": "uniform"}}, "b": {"label": "B"}}
CLAIM = {"score": "psnr_tissue", "method": "b", "than": "a", "expect": "no worse", "by": 9.0, "text": "a guess"}


def write_spec(folder: Path, **changes) -> Path:
    """Two methods on the tiny sequence and one that is not there, three seeds."""
    values = {
        "title": "Tiny",
        "about": "For tests.",
        "sequences": {"tiny": {"path": "tiny"}, "absent": {"path": "nowhere"}},
        "methods": METHODS,
        "seeds": [0, 1, 2],
        "set": TINY,
        "scores": ["psnr_tissue", "depth_rmse_mm", "num_gaussians"],
        "figures": ["budgets", "curves", "frames", "instability", "prior"],
        "claims": [CLAIM],
    } | changes
    path = folder / "spec.yaml"
    path.write_text(yaml.safe_dump(values))
    return path


@pytest.fixture(scope="module")
def finished(tmp_path_factory):
    """A finished benchmark: its spec and folder."""
    folder = tmp_path_factory.mktemp("bench")
    write_tiny_sequence(folder / "tiny")
    spec = write_spec(folder)
    assert main(["bench", str(spec), str(folder / "out"), "--cores", "2"]) == 0
    return spec, folder / "out"


def done_times(out: Path) -> dict[str, int]:
    return {str(path.relative_to(out)): path.stat().st_mtime_ns for path in out.glob("cells/**/cell.json")}


@pytest.mark.slow
def test_report_has_tables_claims_and_pictures(finished):
    _, out = finished
    text = (out / "results.md").read_text()
    assert text.startswith("# Tiny\n\nFor tests.")
    assert "| method | tissue PSNR, dB | depth RMSE, mm | Gaussians |" in text
    assert "B is no worse than a in tissue PSNR, dB by more than 9 dB [a guess]: tiny: **holds**" in text
    assert "No result for 6 cells" in text and "`absent/a/seed0`" in text and "no such folder" in text
    for name in ("budgets", "curves", "frames-tiny", "instability-tiny", "prior-tiny"):
        assert f"figures/{name}.png" in text
        assert cv2.imread(str(out / "figures" / f"{name}.png")).std() > 5
    assert r"\toprule" in (out / "results.tex").read_text()
    facts = json.loads((out / "results.json").read_text())
    assert len(facts["cells"]) == 6 and len(facts["missing"]) == 6
    assert facts["claims"][0]["sequences"]["tiny"]["verdict"] == "holds"
    found = [cell["scores"]["psnr_tissue"] for cell in facts["cells"] if cell["method"] == "a"]
    lines = (out / "results.csv").read_text().splitlines()
    assert f"tiny,a,,0,0,psnr_tissue,{found[0]!r}" in lines
    assert len(set(found)) == 3  # seeds differ


@pytest.mark.slow
def test_equal_cells_have_equal_scores_and_finished_ones_are_kept(finished, capsys):
    spec, out = finished
    before = done_times(out)
    assert len(before) == 6
    assert main(["bench", str(spec), str(out)]) == 0
    assert done_times(out) == before
    assert "12 cells: 6 done before, 0 to run, 6 without data" in capsys.readouterr().out


@pytest.mark.slow
def test_a_changed_method_runs_again_and_the_others_do_not(finished):
    spec, out = finished
    before = done_times(out)
    changed = write_spec(spec.parent, methods=METHODS | {"b": {"label": "B", "set": {"loss.tv_weight": 0.5}}})
    assert main(["bench", str(changed), str(out)]) == 0
    after = done_times(out)
    assert len(set(after) - set(before)) == 3 and before.items() <= after.items()


def test_report_only_trains_nothing(tmp_path, monkeypatch):
    write_tiny_sequence(tmp_path / "tiny")
    monkeypatch.delenv("NOWHERE", raising=False)
    spec = write_spec(tmp_path, sequences={"tiny": {"path": "tiny"}, "unset": {"path": "$NOWHERE/clip"}})
    assert main(["bench", str(spec), str(tmp_path / "out"), "--report-only"]) == 0
    text = (tmp_path / "out" / "results.md").read_text()
    assert "expected the variable NOWHERE, got none" in text
    assert "not run yet" in text and not list((tmp_path / "out").glob("cells/**/cell.json"))


@pytest.mark.slow
def test_a_failing_cell_is_reported_and_does_not_stop_the_rest(tmp_path, capsys):
    write_tiny_sequence(tmp_path / "tiny")
    for file in (tmp_path / "tiny" / "depth").iterdir():  # readable, but nothing to start from
        cv2.imwrite(str(file), cv2.imread(str(file), cv2.IMREAD_UNCHANGED) * 0)
    write_tiny_sequence(tmp_path / "good")
    sequences = {"tiny": {"path": "tiny"}, "good": {"path": "good"}}
    spec = write_spec(tmp_path, sequences=sequences, methods={"b": {}}, seeds=[0], claims=[], figures=["curves"])
    assert main(["bench", str(spec), str(tmp_path / "out")]) == 1
    assert "tiny/b/seed0: failed: exit status 2" in capsys.readouterr().out
    text = (tmp_path / "out" / "results.md").read_text()
    assert "`tiny/b/seed0`: exit status 2" in text and "depth > 0" in text
    assert len(done_times(tmp_path / "out")) == 1


QUIET = {"stdout": subprocess.DEVNULL, "stderr": subprocess.DEVNULL}


@pytest.mark.slow
@pytest.mark.parametrize("how", [signal.SIGINT, signal.SIGKILL])
def test_killed_half_way_it_loses_no_finished_cell(tmp_path, how):
    write_tiny_sequence(tmp_path / "tiny")
    endless = METHODS | {"z": {"set": {"schedule.fine_iterations": 1_000_000}}}
    spec = write_spec(tmp_path, methods=endless, seeds=[0], figures=["curves"], claims=[])
    out = tmp_path / "out"
    command = [sys.executable, "-m", "endoprior", "bench", str(spec), str(out), "--cores", "1"]
    # A background shell has its children ignore Ctrl-C; this one must not.
    process = subprocess.Popen(command, **QUIET, preexec_fn=lambda: signal.signal(signal.SIGINT, signal.SIG_DFL))
    try:
        for _ in range(600):
            logs = [path for path in out.glob("cells/*/run/log.jsonl") if len(done_times(out)) == 2]
            logs = [path for path in logs if not (path.parents[1] / "cell.json").exists() and path.stat().st_size]
            if logs:
                break
            time.sleep(0.1)
        (log,) = logs
        process.send_signal(how)
        code = process.wait(timeout=60)
    finally:
        process.kill()
    assert code == (130 if how == signal.SIGINT else -signal.SIGKILL)
    before = done_times(out)
    assert len(before) == 2
    for _ in range(100):  # the endless cell ends with its parent
        size = log.stat().st_size
        time.sleep(0.8)
        if log.stat().st_size == size:
            break
    else:
        pytest.fail("a worker outlived its benchmark")
    assert (log.parent / "checkpoint.safetensors").exists() == (how == signal.SIGINT)
    spec = write_spec(tmp_path, methods=METHODS, seeds=[0], figures=["curves"], claims=[])
    assert main(["bench", str(spec), str(out)]) == 0
    assert {name: t for name, t in done_times(out).items() if name in before} == before


@pytest.mark.slow
def test_an_interrupted_cell_goes_on_to_the_same_scene(tmp_path):
    from endoprior.data import load_sequence
    from endoprior.runs.train import train
    from endoprior_studies.matrix import run_matrix
    from endoprior_studies.spec_file import load_spec

    write_tiny_sequence(tmp_path / "tiny")
    sequences = {"tiny": {"path": "tiny"}}
    spec = load_spec(write_spec(tmp_path, sequences=sequences, methods={"b": {}}, seeds=[0], claims=[]))
    jobs = []
    run_matrix(spec, tmp_path / "out", lambda found: iter(jobs.extend(found) or []))
    (job,) = jobs
    whole = tmp_path / "whole"
    cfg = spec.config("b", "tiny", None, 0)
    sequence = load_sequence(tmp_path / "tiny", cfg.data)
    train(sequence, cfg, whole)

    def stop(report, trainer):
        if report.iteration == 7:
            os.kill(os.getpid(), signal.SIGINT)

    folder = Path(job.folder)
    folder.mkdir(parents=True)
    (folder / "key").write_text(job.key)
    with pytest.raises(KeyboardInterrupt):
        train(sequence, cfg, folder / "run", on_step=stop)
    from endoprior_studies.worker import finished, work

    work(job)
    assert finished(folder, job.key) and not finished(folder, "another")
    assert (folder / "run" / "scene.safetensors").read_bytes() == (whole / "scene.safetensors").read_bytes()
    metrics = json.loads((folder / "metrics.json").read_text())
    assert "interrupted" in metrics["skipped"]["train_seconds"] and "train_seconds" not in metrics["scores"]


def test_two_benchmarks_do_not_share_a_folder(tmp_path, capsys):
    from filelock import FileLock

    write_tiny_sequence(tmp_path / "tiny")
    (tmp_path / "out").mkdir()
    with FileLock(tmp_path / "out" / ".lock"):
        assert main(["bench", str(write_spec(tmp_path)), str(tmp_path / "out")]) == 2
    assert "no other process is writing" in capsys.readouterr().err


@pytest.mark.parametrize(
    ("options", "said"),
    [
        (["--threads", "0"], "--threads: expected 1 to 4096"),
        (["--data", "tiny"], "NAME=FOLDER"),
        (["--data", "x=y"], "expected one of absent, tiny"),
        (["--weights-dir", "nowhere"], "expected a folder with weights"),
    ],
)
def test_bad_options_are_named(tmp_path, capsys, options, said):
    assert main(["bench", str(write_spec(tmp_path)), str(tmp_path / "out"), *options]) == 2
    assert said in capsys.readouterr().err


@pytest.mark.slow
@pytest.mark.skipif(importlib.util.find_spec("ray") is None, reason="Ray is not installed")
def test_ray_runs_the_same_cells(finished, tmp_path):
    write_tiny_sequence(tmp_path / "tiny")
    spec = write_spec(tmp_path, sequences={"tiny": {"path": "tiny"}}, methods={"a": METHODS["a"]}, seeds=[0], claims=[])
    command = [sys.executable, "-m", "endoprior", "bench", str(spec), str(tmp_path / "out"), "--ray", "local"]
    done = subprocess.run(command, capture_output=True, text=True, timeout=180)
    assert done.returncode == 0, done.stderr
    (cell,) = (tmp_path / "out").glob("cells/*/run/scene.safetensors")
    same = finished[1] / cell.relative_to(tmp_path / "out")
    assert cell.read_bytes() == same.read_bytes()


@pytest.mark.slow
def test_a_folder_of_specs_shares_equal_cells(tmp_path, capsys):
    write_tiny_sequence(tmp_path / "tiny")
    specs = tmp_path / "specs"
    specs.mkdir()
    common = {"sequences": {"tiny": {"path": "../tiny"}}, "seeds": [0], "claims": [], "figures": []}
    twins = {"x": METHODS["a"], "y": METHODS["a"]}  # by two names the same
    write_spec(specs, methods=twins, **common).rename(specs / "1.yaml")
    write_spec(specs, methods=METHODS, **common).rename(specs / "2.yaml")
    assert main(["bench", str(specs), str(tmp_path / "out")]) == 0
    assert "2 cells: 1 done before, 1 to run" in capsys.readouterr().out
    assert len(done_times(tmp_path / "out")) == 2
    assert all((tmp_path / "out" / name / "results.md").exists() for name in "12")
    text = (tmp_path / "out" / "results.md").read_text()
    assert text.startswith("# Results\n\n## Tiny") and text.count("## Tiny") == 2 and text.count("## Protocol") == 1
    assert main(["bench", str(tmp_path / "tiny"), str(tmp_path / "out")]) == 2
    assert "got none. Fix: Pass a folder of specs" in capsys.readouterr().err


@pytest.mark.slow
def test_a_report_can_be_published(finished, tmp_path):
    spec = importlib.util.spec_from_file_location("publish", Path(__file__).parents[1] / "bench" / "publish.py")
    publish = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(publish)
    publish.publish(finished[1], "two", ("curves",), tmp_path)
    (image,) = (tmp_path / "images" / "results").iterdir()
    assert image.name == "two-curves.jpg" and cv2.imread(str(image)) is not None
    values = (tmp_path / "results" / "two.csv").read_text()
    assert values == (finished[1] / "results.csv").read_text()
