"""The benchmarks: the comparison with a baseline, one cheap stage, and that the plain torch yardstick is a fair one."""

import json
import os
import sys
from dataclasses import replace
from pathlib import Path

import pytest
import torch

sys.path.insert(0, str(Path(__file__).parents[1] / "bench"))

import common
import iteration
import ops
import plain
import run
import scenes
from common import Row, Size

from endoprior.data import load_sequence
from endoprior.render import numba as numba_backend

BENCH = Path(common.__file__).parent
TINY = Size(40, 48, 40)
REPEATED = 21
"""An iteration whose frame has a training frame before it."""


def row(ours_ms, torch_ms=100.0, stage="a", num=5):
    return Row(stage, num, 48, 40, ours_ms, torch_ms)


def test_only_ratios_are_compared_and_only_slower_ones_fail(tmp_path):
    common.save([row(10.0), row(10.0, stage="b"), row(1.0, None, "c")], tmp_path / "then.json")
    then = run.load_ratios(tmp_path / "then.json")
    # "a" took twice as long, and so did torch; "b" took twice as long alone; "c" and "d" have nothing to compare.
    now = [row(20.0, 200.0), row(20.0, stage="b"), row(9.0, None, "c"), row(9.0, stage="d")]
    changed = run.changes(now, then)
    assert changed == {now[0]: pytest.approx(1.0), now[1]: pytest.approx(2.0)}
    assert run.worse(changed, 1.5) == [now[1]]
    assert run.worse(changed, 2.5) == []


def test_another_size_is_another_row(tmp_path):
    common.save([row(10.0)], tmp_path / "then.json")
    assert run.changes([row(50.0, num=6)], run.load_ratios(tmp_path / "then.json")) == {}


def test_rows_too_short_to_time_are_not_judged():
    now = row(run.MIN_MS / 2)
    assert run.worse({now: 9.0}, 1.5) == []


@pytest.mark.parametrize(("then_ms", "status"), [(1000.0, 0), (0.1, 1)])
def test_the_exit_status_says_whether_something_is_slower(tmp_path, monkeypatch, capsys, then_ms, status):
    stages = {"a": lambda sizes: [row(10.0)]}
    common.save([row(then_ms)], tmp_path / "then.json")
    monkeypatch.setattr(run, "STAGES", stages)
    monkeypatch.setattr(sys, "argv", ["run.py", "--only", "a", "--baseline", str(tmp_path / "then.json")])
    assert run.main() == status
    assert ("SLOWER" in capsys.readouterr().out) == bool(status)


def test_a_stage_that_looks_slower_is_measured_again(monkeypatch):
    timings = iter([40.0, 11.0, 40.0])
    monkeypatch.setattr(run, "STAGES", {"a": lambda sizes: [row(next(timings)), row(1.0, None, "b")]})
    found = run.measure("a", (TINY,), {run.key(row(10.0)): 0.1}, 1.5)
    assert found == [row(11.0), row(1.0, None, "b")]
    assert next(timings) == 40.0


def test_the_file_holds_facts_and_rows_but_neither_path_nor_host(tmp_path):
    common.save([row(10.0), row(10.0, None, "b")], tmp_path / "now.json")
    text = (tmp_path / "now.json").read_text()
    found = json.loads(text)
    assert found["rows"][0]["ratio"] == 0.1 and found["rows"][1]["ratio"] is None
    assert found["machine"]["numba_threads"] >= 1 and found["versions"]["torch"]
    assert os.uname().nodename not in text and str(tmp_path) not in text and str(BENCH.parent) not in text


def test_the_committed_baseline_can_be_read():
    ratios = run.load_ratios(BENCH / "baseline.json")
    assert {name for name, *_ in ratios} >= {"compositing forward", "iteration default", "iteration paper"}


def test_a_cheap_stage_is_measured_beside_torch():
    steps = (ops.losses(TINY.width, TINY.height, each) for each in (ops.NUMBA, ops.TORCH))
    ((ours_ms, torch_ms),) = common.race(*steps).values()
    assert 0 < ours_ms < 1e4 and 0 < torch_ms < 1e4


def test_parts_inside_parts_are_counted_once():
    class Work:
        def outer(self):
            self.inner()

        def inner(self):
            torch.rand(200_000).sort()

    with common.stopwatch({"outer": [(Work, "outer")], "inner": [(Work, "inner")]}) as taken:
        Work().outer()
    assert 0 <= taken["outer"] < taken["inner"]


@pytest.mark.parametrize("path", sorted(BENCH.glob("*.py")), ids=lambda p: p.name)
def test_idle_threads_are_told_to_sleep_before_torch_is_imported(path):
    lines = path.read_text().splitlines()
    imported = [i for i, line in enumerate(lines) if line.startswith(("import ", "from ")) and "__future__" not in line]
    if path.name == "common.py":
        assert any("OMP_WAIT_POLICY" in line for line in lines[: imported[1]])
    # The first is imported by stages only, the others do without torch.
    elif path.stem not in (
        "plain",
        "publish",
        "figures",
        "method_figures",
        "symptom_figures",
        "gpu_parity",
        "gpu_training",
        "golden",
    ):
        assert path.stem == "run" or is_common(next(lines[i] for i in imported if is_foreign(lines[i])))


def is_common(line):
    return line.split("#")[0].strip() == "import common"


def is_foreign(line):
    return line.split()[1].split(".")[0] not in sys.stdlib_module_names


def test_plain_torch_draws_the_same_picture_with_the_same_gradients():
    splats, camera = scenes.splats(TINY)
    leaves = [t.requires_grad_() for t in (splats.means, splats.quats, splats.scales, splats.opacities, splats.sh)]
    drawn = [r(splats, camera, background=torch.ones(3)) for r in (numba_backend.rasterize, plain.rasterize)]
    torch.testing.assert_close(drawn[1].color, drawn[0].color, rtol=0, atol=1e-4)
    torch.testing.assert_close(drawn[1].depth, drawn[0].depth, rtol=0, atol=1e-2)
    torch.testing.assert_close(drawn[1].alpha, drawn[0].alpha, rtol=0, atol=1e-4)
    ours, theirs = (torch.autograd.grad(out.color.square().sum() + out.depth.sum(), leaves) for out in drawn)
    for mine, other in zip(ours, theirs, strict=True):
        assert (mine - other).norm() < 1e-3 * other.norm()


@pytest.mark.parametrize("name", ["default", pytest.param("paper", marks=pytest.mark.slow)])
def test_plain_torch_trains_on_the_same_terms(make_tiny_sequence, name):
    cfg = iteration.config(name, 300)
    planes = replace(cfg.deformation.hexplane, time_resolution=6, channels=4, multires=(1, 2))
    cfg = replace(
        cfg,
        deformation=replace(cfg.deformation, hexplane=planes),
        temporal=replace(cfg.temporal, min_valid=0, min_points=20, weight=1.0),
    )
    sequence = load_sequence(make_tiny_sequence(num_frames=iteration.FRAMES))
    trainer, other = iteration.started(sequence, cfg), iteration.started(sequence, cfg, ops.TORCH)
    want, got = iteration.repeat(trainer, REPEATED), iteration.repeat(other, REPEATED)
    assert "distance" in want.terms, "the iteration had no frame before: repeat another one"
    assert got.terms == pytest.approx(want.terms, rel=1e-3, abs=1e-7)
    gradients = [t.state.stats.grad2d_ndc_sum for t in (trainer, other)]
    assert (gradients[1] - gradients[0]).norm() < 1e-3 * gradients[0].norm()
