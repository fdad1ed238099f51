"""The GPU benchmark without a GPU: its dry run, and what it makes of a backend that is wrong or cannot run."""

from __future__ import annotations

import importlib
import json
import sys
import zipfile
from pathlib import Path

import pytest
import torch
from gsplat_stand_in import NAN, loaded, rasterize_to_pixels

GPU_BENCH = Path(__file__).parents[1] / "bench" / "gpu.py"


def gpu_bench(monkeypatch):
    monkeypatch.syspath_prepend(str(GPU_BENCH.parent))
    return importlib.import_module("gpu")


def gpu_contest(monkeypatch):
    """The CPU in the GPU's place."""
    return gpu_bench(monkeypatch).Contest("cpu", torch.device("cpu"))


@pytest.mark.slow
def test_gpu_bench_dry_run_agrees_times_and_writes(tmp_path, monkeypatch, capsys):
    out = tmp_path / "gpu.json"
    options = ["--dry-run", "--scenes", "1", "--gaussians", "50", "--laps", "1", "--out", str(out)]
    assert gpu_bench(monkeypatch).main(options) == 0
    found, printed = json.loads(out.read_text()), capsys.readouterr().out
    assert [g["agrees"] for g in found["gaps"]] == [True, True] and found["facts"]["GPU"].startswith("none")
    assert len(found["laps"]) == 5 and all(lap["ms"] > 0 for lap in found["laps"])
    columns = {len(block.splitlines()[0].split("|")) for block in printed.split("\n\n")}
    assert len(found["runs"]) == 1 and found["runs"][0]["scores"]["psnr_tissue"] > 5
    assert len(columns) == 4 and all(
        len({line.count("|") for line in block.strip().splitlines()}) == 1 for block in printed.split("\n\n")
    )


def test_gpu_bench_can_have_the_kernels_interpreted(monkeypatch):
    """That they agree, test_render_triton.py says on smaller scenes."""
    gpu = gpu_bench(monkeypatch)
    (contest,) = gpu.contests(gpu.arguments().parse_args(["--interpreted"]))
    assert (contest.backend, contest.device.type) == ("triton", "cpu")


def test_gpu_bench_sees_a_backend_that_draws_something_else(monkeypatch):
    gpu, cuda = gpu_bench(monkeypatch), loaded(monkeypatch, kernels=object())
    contest, case = gpu.Contest("cuda", torch.device("cpu")), gpu.random_case(1)
    assert gpu.gap(contest, "cpu", case).agrees
    for factor in (1.002, NAN):
        monkeypatch.setattr(cuda.gsplat, "rasterize_to_pixels", scaled_color(factor))
        found = gpu.gap(contest, "cpu", case)
        assert not found.agrees and found.stray > 0.01


def scaled_color(factor):
    """A rasterizer that is wrong by a factor."""

    def wrong(*args, **options):
        drawn, alpha = rasterize_to_pixels(*args, **options)
        return drawn * factor, alpha

    return wrong


def test_gpu_bench_says_what_the_device_cannot_do_yet(monkeypatch):
    def broken():
        raise TypeError("can't convert cuda:0 device type tensor to numpy.\nUse Tensor.cpu()")

    lap = gpu_bench(monkeypatch).timed(gpu_contest(monkeypatch), "deformed", 7, broken, 1)
    assert lap.ms is None and lap.note == "not possible: can't convert cuda:0 device type tensor to numpy."


def test_gpu_bench_unpacks_a_wheel_beside_itself(tmp_path, monkeypatch):
    wheel = tmp_path / "gsplat-9.whl"
    with zipfile.ZipFile(wheel, "w") as archive:
        archive.writestr("gsplat_in_a_wheel/__init__.py", "FOUND = True\n")
    monkeypatch.setattr(sys, "path", list(sys.path))
    gpu_bench(monkeypatch).use_wheel(wheel)
    assert importlib.import_module("gsplat_in_a_wheel").FOUND


def test_gpu_bench_without_a_gpu_says_so(monkeypatch, capsys):
    monkeypatch.setattr(torch.cuda, "is_available", lambda: False)
    assert gpu_bench(monkeypatch).main([]) == 2
    assert "expected a GPU" in capsys.readouterr().err
