"""Made-up machines for the tests of the doctor: one with everything, and kinds of every part; programs that answer."""

import os
from dataclasses import replace
from pathlib import Path

from hypothesis import strategies as st

from endoprior.doctor import Facts, toolchain
from endoprior.doctor import facts as facts_module
from endoprior.doctor.records import Builders, Driver, Gpu, Gsplat, System, Toolkit, Torch, Triton

H200 = Gpu("NVIDIA H200", (9, 0), 139.0, True)
NEW_CARD = Gpu("NVIDIA B200", (10, 0), 180.0, True)
OLD_CARD = Gpu("Quadro P2000", (6, 1), 5.0, True)
NO_KERNEL = Gpu("NVIDIA B200", (10, 0), 180.0, False, "CUDA error: no kernel image is available for execution")
WORKING = Facts(
    driver=Driver(1, "580.65.06", True, "nvidia-smi", "580.65.06", "13.0", (H200,)),
    torch=Torch(
        "2.13.0+cu130", "13.0", available=True, gpus=(H200,), extensions="cache", host_compilers={"13.0": [16]}
    ),
    triton=Triton("3.7.1", "triton==3.7.1", True),
    gsplat=Gsplat("1.5.3", cached="cache/gsplat_cuda/gsplat_cuda.so", loads=True),
    toolkit=Toolkit("/usr/local/cuda", "default", "13.0", "", True, libraries="/usr/local/cuda/lib64", cudart=True),
    builders=Builders("c++", "12.2.0", True, c_compiler="gcc", c_version="12.2.0", ninja="1.11", python_headers=True),
)
"""A machine with everything."""
NO_TRITON = replace(WORKING, triton=Triton("3.7.1", "triton==3.7.1", False, "RuntimeError"))
"""The same, but Triton does not work and no fix is known: only gsplat is left."""
ONLY_TRITON = replace(WORKING, gsplat=Gsplat(), toolkit=Toolkit(pip="/venv/nvidia/cu13"))
"""As a plain installation leaves a machine with a driver and torch for CUDA: no gsplat, no toolkit."""
NO_GPU = replace(WORKING, driver=Driver(0), torch=Torch("2.13.0+cu130", "13.0", available=False, reason="no driver"))
"""Where an image is built."""
CHOICES = {
    "system": [System(), System(name="Windows"), System(name="Darwin"), System(container=True, packages="apt-get")],
    "driver": [
        Driver(), Driver(0), Driver(2), WORKING.driver, Driver(1, "550.1", False, "", "550.1", "12.4"),
        Driver(1, "570.1", True, "nvidia-smi", "570.1", "12.8", (replace(NEW_CARD, computes=None),)),
        Driver(1, "470.1", True, "nvidia-smi", "470.1", "11.4", (H200,)), Driver(0, tool="nvidia-smi", error="failed"),
        Driver(1, "580.1", True, "nvidia-smi", error="nvidia-smi gave no answer in 10 s"),
        Driver(None, "580.1", True, "nvidia-smi", "580.1", "13.0", (OLD_CARD,)), Driver(None, device_files=True),
        Driver(1, "390.1", True, "nvidia-smi", "390.1", "9.1"),
    ],
    "torch": [
        Torch(), Torch("2.13.0+cpu"), Torch("2.13.0+rocm7", hip="7.2"), Torch("2.13.0", "13.0", error="libcudart.so"),
        Torch("2.3.0", "12.1", available=True, gpus=(H200,)), WORKING.torch, Torch("2.13.0", "13.0", available=False),
        Torch("2.13.0", "12.6", available=True, gpus=(NO_KERNEL,)), Torch("2.13.0", "12.6", available=False),
        Torch("2.13.0", "13.0", available=True, gpus=(replace(NO_KERNEL, error="out of memory"), H200)),
        Torch("2.13.0", "13.0", available=True), Torch("2.13.0", "13.0", error="python gave no answer in 90 s"),
        Torch("2.13.0", "13.0", available=True, gpus=(OLD_CARD, H200)),
    ],
    "triton": [
        Triton(), WORKING.triton, Triton("3.7.1"), Triton(wanted="triton==3.7.1", error="undefined symbol"),
        Triton("3.7.1", "triton==3.7.1", False, "libcuda.so cannot found!"), Triton("3.7.1", computes=False),
        Triton("3.7.1", "triton==3.7.1", False, "cuda_utils.c:5:10: fatal error: stdio.h: No such file"),
        Triton("3.7.1", "", False, "[Errno 13] Permission denied: '/.triton'"),
    ],
    "gsplat": [
        Gsplat(), Gsplat("1.5.2"), Gsplat("1.5.3"), WORKING.gsplat, Gsplat("1.5.3", prebuilt="csrc.so", loads=True),
        Gsplat("1.5.3", prebuilt="csrc.so", loads=False, error="undefined symbol"),
        replace(WORKING.gsplat, loads=False, error="undefined symbol"), Gsplat("1.5.3", loads=False, error="nvcc died"),
        replace(WORKING.gsplat, compiled_by="/cuda/bin/nvcc"), replace(WORKING.gsplat, current=False),
    ],
    "toolkit": [
        Toolkit(), WORKING.toolkit, Toolkit(pip="/venv/nvidia/cu13"),
        Toolkit("/usr/local", "PATH", "13.0", "", False, "", (("/usr/local/cuda-13.0", "13.0"),)),
        Toolkit("/usr", "PATH", "11.5", "", True, libraries="/usr/lib64"), Toolkit("/usr", "PATH", "12.8", "", True),
        Toolkit("/usr", "PATH", "12.0", "", True, "", (("/opt/cuda-13.0", "13.0"),), cudart=True),
        Toolkit("/gone", "CUDA_HOME", "", "no /gone/bin/nvcc"), Toolkit("/p", "CUDA_HOME", "", "no nvcc", pip="/p"),
        Toolkit("/c", "PATH", "13.1", "", False, "/c/targets/x/include"),
        Toolkit("/p", "CUDA_HOME", "13.0", "", True, libraries="/p/lib", cudart_name="libcudart.so.13", pip="/p"),
    ],
    "builders": [
        Builders(), WORKING.builders, Builders("g++", "13.1", True),
        Builders("c++", "16.1.0", True, "", (13,), "gcc", "16.1.0", ninja="1.11", python_headers=True),
        Builders("c++", "9.4.0", True, "", (), "gcc", "9.4.0", ninja="1.11", python_headers=True),
        Builders("c++", "13.1.0", True, ninja_beside_python="/venv/bin", python_headers=True),
        Builders("g++", "13.1", True, c_compiler="ccache gcc", c_error="no ccache gcc on PATH", python_headers=True),
    ],
}  # fmt: skip


def machines():
    """Facts of every kind of machine above; all pairs of kinds are met many times."""
    names = list(CHOICES)
    return st.tuples(*(st.sampled_from(CHOICES[name]) for name in names)).map(
        lambda picked: Facts(**dict(zip(names, picked, strict=True)), variables={})
    )


def program(folder: Path, name: str, body: str) -> Path:
    """A script on its own; returns its path."""
    file = folder / name
    file.parent.mkdir(parents=True, exist_ok=True)
    file.write_text(f"#!/bin/sh\n{body}\n")
    file.chmod(0o755)
    return file


def bare_machine(tmp_path: Path, monkeypatch) -> Path:
    """A folder that is first on PATH, on a machine without variables of CUDA and packages of NVIDIA."""
    folder = tmp_path / "bin"
    folder.mkdir()
    monkeypatch.setenv("PATH", f"{folder}{os.pathsep}/usr/bin{os.pathsep}/bin")
    for name in (*facts_module.VARIABLES, "LIBRARY_PATH"):
        monkeypatch.delenv(name, raising=False)
    monkeypatch.setattr(toolchain, "pip_folder", lambda: "")
    return folder
