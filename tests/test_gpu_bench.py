"""The GPU benchmark without a GPU: its dry run, and backends that are wrong or fail."""

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


def cpu_target(monkeypatch):
    """The CPU in place of a GPU."""
    return gpu_bench(monkeypatch).Target("numba", torch.device("cpu"))


@pytest.mark.slow
def test_gpu_bench_dry_run_agrees_times_and_writes(tmp_path, monkeypatch, capsys):
    out = tmp_path / "gpu.json"
    options = ["--dry-run", "--scenes", "1", "--gaussians", "50", "--repeats", "1", "--out", str(out)]
    assert gpu_bench(monkeypatch).main(options) == 0
    found, printed = json.loads(out.read_text()), capsys.readouterr().out
    assert [d["agrees"] for d in found["differences"]] == [True, True] and found["facts"]["GPU"].startswith("none")
    assert len(found["timings"]) == 5 and all(timing["ms"] > 0 for timing in found["timings"])
    columns = {len(block.splitlines()[0].split("|")) for block in printed.split("\n\n")}
    assert len(found["runs"]) == 1 and found["runs"][0]["scores"]["psnr_tissue"] > 5
    assert len(columns) == 4 and all(
        len({line.count("|") for line in block.strip().splitlines()}) == 1 for block in printed.split("\n\n")
    )


def test_gpu_bench_can_interpret_the_kernels(monkeypatch):
    """That they agree, test_render_triton.py says on smaller scenes."""
    gpu = gpu_bench(monkeypatch)
    (target,) = gpu.targets(gpu.arguments().parse_args(["--interpreted"]))
    assert (target.backend, target.device.type) == ("triton", "cpu")


def test_gpu_bench_notices_a_wrong_backend(monkeypatch):
    gpu, gsplat = gpu_bench(monkeypatch), loaded(monkeypatch, kernels=object())
    target, case = gpu.Target("gsplat", torch.device("cpu")), gpu.random_case(1)
    assert gpu.compared(target, "numba", case).agrees
    for factor in (1.002, NAN):
        monkeypatch.setattr(gsplat.gsplat, "rasterize_to_pixels", scaled_color(factor))
        found = gpu.compared(target, "numba", case)
        assert not found.agrees and found.stray > 0.01


def scaled_color(factor):
    """A rasterizer that is wrong by a factor."""

    def wrong(*args, **options):
        blended, alpha = rasterize_to_pixels(*args, **options)
        return blended * factor, alpha

    return wrong


def test_gpu_bench_reports_what_fails(monkeypatch):
    def broken():
        raise TypeError("can't convert cuda:0 device type tensor to numpy.\nUse Tensor.cpu()")

    timing = gpu_bench(monkeypatch).timed(cpu_target(monkeypatch), "deformed", 7, broken, 1)
    assert timing.ms is None and timing.note == "failed: can't convert cuda:0 device type tensor to numpy."


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
