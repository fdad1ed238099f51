"""The doctor and compilers: toolkits of every make, what pip brings, and what each of them lacks."""

import os
import sys
from dataclasses import replace

import pytest
from doctor_machines import NO_TRITON, ONLY_TRITON, WORKING, bare_machine, program

from endoprior.doctor import examine, toolchain
from endoprior.doctor.facts import read_gsplat
from endoprior.doctor.records import Gsplat, System, Toolkit, Torch
from endoprior.doctor.toolchain import find_builders, find_toolkit


@pytest.fixture
def path(tmp_path, monkeypatch):
    return bare_machine(tmp_path, monkeypatch)


NVCC = "echo 'Cuda compilation tools, release 13.0, V13.0.88'"


def test_toolkit_is_found_where_torch_looks(tmp_path, path, monkeypatch):
    default = tmp_path / "local/cuda"
    assert find_toolkit(default) == Toolkit()
    program(tmp_path / "local/cuda-12.6/bin", "nvcc", NVCC.replace("13.0", "12.6"))
    assert find_toolkit(default) == Toolkit(), "without headers it is of no use"
    (tmp_path / "local/cuda-12.6/include").mkdir()
    (tmp_path / "local/cuda-12.6/include/cuda_runtime.h").touch()
    others = ((str(tmp_path / "local/cuda-12.6"), "12.6"),)
    assert find_toolkit(default) == Toolkit(others=others)
    program(default / "bin", "nvcc", "echo garbage")
    found = find_toolkit(default)
    assert (found.home, found.home_from, found.nvcc) == (str(default), "default", "") and "no version" in found.error
    program(path, "nvcc", NVCC)  # a wrapper far from its headers, as package managers leave it
    found = find_toolkit(default)
    assert found == Toolkit(str(tmp_path), "PATH", "13.0", "", False, "", others, str(tmp_path / "lib64"))
    header = tmp_path / "targets/x86_64-linux/include/cuda_runtime.h"
    header.parent.mkdir(parents=True)
    header.touch()
    assert find_toolkit(default).headers_elsewhere == str(header.parent)
    monkeypatch.setenv("CUDA_INC_PATH", str(header.parent))
    assert find_toolkit(default).headers
    monkeypatch.setenv("CUDA_HOME", str(tmp_path / "gone"))
    found = find_toolkit(default)
    assert found.home_from == "CUDA_HOME" and "gone" in found.error


def test_nvcc_that_hangs(tmp_path, path):
    program(path, "nvcc", "sleep 30")
    assert "no answer" in find_toolkit(tmp_path / "none", limit_s=0.3).error


@pytest.mark.parametrize(
    ("body", "version", "is_gcc"),
    [
        (
            "echo 'c++ (Debian 12.2.0-14+deb12u1) 12.2.0'; echo 'Copyright (C) Free Software Foundation, Inc.'",
            "12.2.0",
            True,
        ),
        ("echo 'Apple clang version 17.0.0 (clang-1700)'", "17.0.0", False),
        ("echo nonsense", "", False),
        ("sleep 30", "", False),
    ],
)
def test_compilers(path, body, version, is_gcc):
    program(path, "c++", body)
    found = find_builders(limit_s=0.5)
    assert (found.compiler_version, found.compiler_is_gcc) == (version, is_gcc)
    assert bool(found.compiler_error) == (not version)


def test_ninja_beside_python_but_not_on_path(tmp_path, monkeypatch, path):
    monkeypatch.setenv("PATH", str(path))
    monkeypatch.setattr(sys, "executable", str(tmp_path / "venv/bin/python"))
    program(tmp_path / "venv/bin", "ninja", "echo 1.13")
    found = find_builders()
    assert found.ninja == "" and found.ninja_beside_python == str(tmp_path / "venv/bin")
    builders = replace(WORKING.builders, ninja="", ninja_beside_python=found.ninja_beside_python)
    assert examine(replace(NO_TRITON, builders=builders)).next_step == f'export PATH={tmp_path}/venv/bin:"$PATH"'


def test_toolkits_that_are_here_are_used_before_others_are_installed():
    def step(toolkit, **changes):
        return examine(replace(NO_TRITON, toolkit=toolkit, **changes)).next_step

    beside = Toolkit("/usr/local", "PATH", "13.0", "", False, "", (("/usr/local/cuda-13.0", "13.0"),))
    assert step(beside) == "export CUDA_HOME=/usr/local/cuda-13.0"
    older = Toolkit("/usr", "PATH", "12.0", "", True)
    assert step(older) == PIP, "a few wheels, where another torch would be gigabytes"
    for_12 = replace(WORKING.torch, version="2.13.0+cu126", cuda="12.6")
    oldest = Toolkit("/usr", "PATH", "11.5", "", True)
    assert "cuda-toolkit-12-6" in step(oldest, torch=for_12, system=System(packages="apt-get"))
    assert "archive" in step(Toolkit(pip="/venv/nvidia/cu13"), torch=for_12), "wheels for 12 make no toolkit"
    both = replace(NO_TRITON, toolkit=older, torch=Torch("2.13.0+cpu"))
    assert examine(both).next_step.endswith("whl/cu126"), "torch is chosen to fit the toolkit"
    assert "nvcc" not in [line.name for line in examine(both).lines if line.part == "gsplat" and line.state != "ok"]
    assert step(Toolkit("/gone", "CUDA_HOME", "", "no /gone/bin/nvcc")) == "unset CUDA_HOME"


PIP = "pip install 'cuda-toolkit[nvcc,cccl]==13.0.*'"
"""Brings nvcc of the minor version of the headers that torch brought."""


def test_a_toolkit_from_pip_step_by_step(tmp_path, path, monkeypatch):
    """Nothing, then nvcc, then CUDA_HOME, then the link that wheels leave out: each look names what is next."""
    folder = tmp_path / "site packages/nvidia/cu13"
    (folder / "lib").mkdir(parents=True)
    (folder / "lib/libcudart.so.13").touch()
    monkeypatch.setattr(toolchain, "pip_folder", lambda: str(folder))
    machine = replace(NO_TRITON, gsplat=Gsplat("1.5.3"))

    def step():
        toolkit = find_toolkit(tmp_path / "none")
        return examine(replace(machine, toolkit=toolkit)).next_step

    assert step() == f"{PIP} && export CUDA_HOME='{folder}'"
    monkeypatch.setenv("CUDA_HOME", str(folder))
    assert step() == PIP, "the variable is right already"
    monkeypatch.delenv("CUDA_HOME")
    program(folder / "bin", "nvcc", NVCC)
    (folder / "include").mkdir()
    (folder / "include/cuda_runtime.h").touch()
    assert step() == f"export CUDA_HOME='{folder}'"
    monkeypatch.setenv("CUDA_HOME", str(folder))
    assert step() == f"ln -sf libcudart.so.13 '{folder}/lib/libcudart.so'"
    (folder / "lib/libcudart.so").symlink_to("libcudart.so.12")
    assert step().startswith("ln -sf"), "a link to nothing"
    assert os.system(step()) == 0
    assert (folder / "lib/libcudart.so").resolve() == folder / "lib/libcudart.so.13"
    assert step() == "endoprior doctor --compile"


def test_pip_s_folder_is_found_without_importing_it(tmp_path, monkeypatch):
    monkeypatch.setattr(sys, "path", [str(tmp_path)])
    sys.path_importer_cache.pop(str(tmp_path), None)
    monkeypatch.delitem(sys.modules, "nvidia", raising=False)
    assert toolchain.pip_folder() == ""
    (tmp_path / "nvidia/cu13").mkdir(parents=True)
    sys.path_importer_cache.pop(str(tmp_path), None)
    assert toolchain.pip_folder() == str(tmp_path / "nvidia/cu13") and "nvidia" not in sys.modules


def test_libcudart_is_looked_for_where_the_linker_looks(tmp_path, path, monkeypatch):
    monkeypatch.setenv("CUDA_HOME", str(tmp_path))
    (tmp_path / "lib").mkdir()
    (tmp_path / "lib/libcudart.so").touch()
    found = find_toolkit()
    assert (found.libraries, found.cudart) == (str(tmp_path / "lib"), True)
    (tmp_path / "lib64").mkdir()  # torch takes it where it is there, whatever is in it
    found = find_toolkit()
    assert (found.libraries, found.cudart, found.cudart_name) == (str(tmp_path / "lib64"), False, "")
    program(path, "c++", f'case "$1" in -print-file-name=libcudart.so) echo {tmp_path}/lib/libcudart.so;; esac')
    assert find_toolkit().cudart, "the linker's own folders, as Debian has it"
    program(path, "c++", "echo libcudart.so")
    assert not find_toolkit().cudart, "what a compiler says that did not find it"


def test_a_library_that_is_nowhere():
    toolkit = replace(WORKING.toolkit, cudart=False)
    machine = replace(NO_TRITON, toolkit=toolkit, gsplat=Gsplat("1.5.3"))
    assert examine(machine).blocking.name == "CUDA library" and examine(machine).next_step == PIP
    assert examine(replace(machine, gsplat=WORKING.gsplat)).works, "what is compiled is not linked again"


@pytest.mark.parametrize(
    ("version", "cuda", "step"),
    [
        ("16.0.1", "13.0", "export CC=gcc-14 CXX=g++-14"),
        ("9.4.0", "13.0", "export CC=gcc-14 CXX=g++-14"),
        ("9.4.0", "12.6", "nothing: CUDA works, with gsplat"),
        ("10.2.1", "13.0", "nothing: CUDA works, with gsplat"),
    ],
)
def test_a_gcc_that_nvcc_or_cpp20_rejects_is_replaced_by_one_that_is_installed(version, cuda, step):
    builders = replace(WORKING.builders, compiler_version=version, other_gcc=(9, 12, 14, 17))
    torch = replace(WORKING.torch, cuda=cuda)
    toolkit = replace(WORKING.toolkit, nvcc=cuda)
    assert examine(replace(NO_TRITON, builders=builders, torch=torch, toolkit=toolkit)).next_step == step
    none = replace(builders, other_gcc=(9,))
    if step.startswith("export"):
        assert "g++ 15" in examine(replace(NO_TRITON, builders=none, torch=torch, toolkit=toolkit)).next_step


@pytest.mark.parametrize(
    ("cc", "found"),
    [(None, ("gcc", "12.2.0")), ("clang", ("clang", "17.0.0")), ("ccache gcc", ("ccache gcc", "")), ("", ("", ""))],
)
def test_the_c_compiler_is_the_one_triton_takes(path, monkeypatch, cc, found):
    """CC as one word, else gcc, else clang."""
    monkeypatch.setenv("PATH", str(path))
    assert find_builders().c_error == "no gcc, no clang on PATH"
    program(path, "clang", "echo 'clang version 17.0.0'")
    assert find_builders().c_compiler == "clang"
    program(path, "gcc", "echo 'gcc (Debian 12.2.0-14) 12.2.0'")
    program(path, "ccache", "echo 'ccache version 4.8'")
    if cc is not None:
        monkeypatch.setenv("CC", cc)
    builders = find_builders()
    assert (builders.c_compiler, builders.c_version) == found
    machine = replace(ONLY_TRITON, builders=replace(WORKING.builders, c_version=found[1], c_error=builders.c_error))
    named = replace(machine, variables={} if cc is None else {"CC": cc})
    assert examine(named).next_step == ("nothing: CUDA works, with Triton" if found[1] else "unset CC")


@pytest.mark.parametrize(
    ("change", "says"),
    [
        ({}, ""),
        ({"compiled_by": "/usr/local/cuda/bin/nvcc"}, ""),
        ({"compiled_by": "/usr/local/cuda-13.0/bin/nvcc"}, "CUDA_HOME is now /usr/local/cuda"),
        ({"current": True}, ""),
        ({"current": False}, "another ninja"),
    ],
)
def test_what_would_be_compiled_again_is_not_called_ready(change, says):
    report = examine(replace(NO_TRITON, gsplat=replace(WORKING.gsplat, **change)))
    line = next(line for line in report.lines if line.name == "gsplat compiled")
    assert (line.state, says in line.found) == ("missing" if says else "ok", True)
    assert report.only_to_compile == bool(says) and ("compiles again" in line.found) == bool(says)


@pytest.mark.parametrize(("ninja", "current"), [("ninja: no work to do.", True), ("[1/30] nvcc", False)])
def test_ninja_is_asked_what_it_would_do(tmp_path, path, monkeypatch, ninja, current):
    for folder in ("gsplat", "gsplat_cuda"):
        (tmp_path / folder).mkdir()
    monkeypatch.syspath_prepend(str(tmp_path))
    torch, build = Torch(extensions=str(tmp_path)), tmp_path / "gsplat_cuda"
    program(path, "ninja", f'test "$*" = "-C {build} -n" && echo "{ninja}"')
    assert read_gsplat(torch) == Gsplat("?"), "nothing was compiled there by torch"
    (build / "build.ninja").write_text("cxx = c++\nnvcc = /usr/local/cuda/bin/nvcc\n\ncflags = x\n")
    assert read_gsplat(torch) == Gsplat("?", compiled_by="/usr/local/cuda/bin/nvcc", current=current)
    program(path, "ninja", "exit 1")
    assert read_gsplat(torch).current is None
