"""The Triton kernels compiled for GPUs that are not here, and the interpreted tests in a process of their own.

What a compiler can tell without a GPU: that every kernel compiles as it is launched, that nothing spills to memory,
and that the two compositing kernels wait for no other warp.
"""

from __future__ import annotations

import importlib
import os
import re
import subprocess
import sys
from pathlib import Path
from types import SimpleNamespace

import pytest
import torch
from render_scenes import camera, cast, splats

triton = pytest.importorskip("triton")
GPUTarget = pytest.importorskip("triton.backends.compiler").GPUTarget
if os.environ.get("TRITON_INTERPRET") == "1":
    pytest.skip("interpreted kernels are not compiled", allow_module_level=True)

backend, *modules = (
    importlib.import_module(f"endoprior.render.triton{name}") for name in ("", ".tiles", ".projection", ".composite")
)
pytestmark = pytest.mark.slow
KERNELS = {
    *("project_forward", "count_pairs", "write_pairs", "index_pairs", "composite_forward"),
    *("composite_backward", "gather", "project_backward"),
}


@pytest.fixture(scope="module", params=[80, 90], ids=["A100", "H100"])
def compiled(request, tmp_path_factory):
    """The kernels of one image and its gradients by name, compiled for the arguments they were launched with."""
    found, launch = {}, triton.JITFunction.run

    def compile_only(kernel, *args, grid, warmup, **options):
        found[kernel.__name__] = launch(kernel, *args, grid=grid, warmup=True, **options)

    driver = SimpleNamespace(  # compiled kernels are kept by device: a number that no GPU has
        get_current_device=lambda: request.param,
        get_current_stream=lambda device: 0,
        get_current_target=lambda: GPUTarget("cuda", request.param, 32),
    )
    with pytest.MonkeyPatch.context() as patch:
        patch.setenv("TRITON_CACHE_DIR", str(tmp_path_factory.mktemp("triton")))
        patch.setattr(triton.JITFunction, "run", compile_only)
        patch.setattr(backend, "DEVICE", "cpu")
        triton.runtime.driver.set_active(driver)
        try:
            view = camera()
            patch.setattr(modules[0], "read_num_pairs", lambda slot_ends: 100)  # nothing was counted
            out = backend.rasterize(cast(splats(view), torch.float32), view, background=torch.zeros(3))
            (out.color.sum() + out.alpha.sum() + out.depth.sum()).backward()
        finally:
            triton.runtime.driver.set_active(None)
    return found


def usage(kernel, tmp_path):
    """Registers, bytes of stack, and bytes of local memory, per thread."""
    tool = Path(triton.__file__).parent / "backends" / "nvidia" / "bin" / "cuobjdump"
    if not tool.exists():
        pytest.skip(f"no {tool} to read the binary with")
    (tmp_path / "kernel.cubin").write_bytes(kernel.asm["cubin"])
    told = subprocess.run([tool, "-res-usage", tmp_path / "kernel.cubin"], capture_output=True, text=True, check=True)
    return [int(re.search(rf"\b{what}:(\d+)", told.stdout)[1]) for what in ("REG", "STACK", "LOCAL")]


@pytest.mark.parametrize("name", sorted(KERNELS))
def test_compiles_and_spills_nothing(compiled, name, tmp_path):
    registers, stack, local = usage(compiled[name], tmp_path)
    assert 16 <= registers <= 200 and stack == 0 and local == 0


@pytest.mark.parametrize("name", ["composite_forward", "composite_backward"])
def test_compositing_waits_for_no_other_warp(compiled, name, tmp_path):
    """One warp, nothing shared. The backward loop, compiled three times over, needs sixteen shuffles per pair."""
    kernel = compiled[name]
    assert usage(kernel, tmp_path)[0] <= 80  # 24 warps on a multiprocessor; 20 of them are an image of 640x512
    assert kernel.metadata.num_warps == 1 and kernel.metadata.shared == 0 and "bar.sync" not in kernel.asm["ptx"]
    assert kernel.asm["ptx"].count("shfl.sync") <= 3 * 16


def test_every_kernel_is_under_test():
    """Kernels have docstrings, parts of them comments."""
    defined = {
        value.__name__
        for module in modules
        for value in vars(module).values()
        if isinstance(value, triton.JITFunction) and value.__doc__ and value.module == module.__name__
    }
    assert defined == KERNELS


def test_is_for_cuda_devices_unless_interpreted():
    assert backend.DEVICE == "cuda"


def test_kernels_agree_when_interpreted():
    """`test_render_triton.py`, which says what agrees with what."""
    tests = Path(__file__).with_name("test_render_triton.py")
    run = subprocess.run(
        [sys.executable, "-m", "pytest", "-p", "no:cacheprovider", str(tests)],
        env=os.environ | {"TRITON_INTERPRET": "1"},
        capture_output=True,
        text=True,
    )
    assert run.returncode == 0 and "passed" in run.stdout and "skipped" not in run.stdout, run.stdout + run.stderr
