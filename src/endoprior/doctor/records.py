"""The facts of a machine: plain values, as they were found.

Versions are text as the program prints them ("13.0"), empty where there is none; `number` makes them comparable. None
means: not tried, or no answer.
"""

from __future__ import annotations

import re
from dataclasses import dataclass, field


def number(version: str) -> tuple[int, ...]:
    """The leading numbers of a version, for comparing: (13, 0) of "13.0", () of ""."""
    found = re.match(r"\d+(?:\.\d+)*", version)
    return tuple(int(part) for part in found[0].split(".")) if found else ()


@dataclass(frozen=True)
class System:
    """The computer and its Python."""

    name: str = "Linux"
    """"Linux", "Windows" or "Darwin", as Python's `platform.system` has it."""
    release: str = ""
    machine: str = "x86_64"
    python: str = "3.11"
    cores: int = 1
    free_gb: float | None = None
    """Memory this process can still take, GB."""
    container: bool = False
    packages: str = ""
    """The first package manager found: "apt-get", "dnf", "zypper", "pacman" or ""."""


@dataclass(frozen=True)
class Gpu:
    """One GPU."""

    name: str
    capability: tuple[int, int] | None = None
    """Compute capability, (9, 0) for an H200."""
    memory_gb: float | None = None
    computes: bool | None = None
    """Whether torch added two numbers on it; None if that was not tried."""
    error: str = ""
    """Why it did not compute."""


@dataclass(frozen=True)
class Driver:
    """NVIDIA's driver."""

    on_bus: int | None = None
    """NVIDIA display controllers on the PCI bus; None where the bus cannot be read."""
    module: str = ""
    """Version of the loaded kernel module."""
    device_files: bool = False
    """Whether this process can reach a GPU: /dev/nvidia0, or the device file of WSL."""
    tool: str = ""
    """Path of nvidia-smi."""
    version: str = ""
    cuda: str = ""
    """The newest CUDA it serves."""
    gpus: tuple[Gpu, ...] = ()
    error: str = ""
    """The error of nvidia-smi."""


@dataclass(frozen=True)
class Torch:
    """PyTorch."""

    version: str = ""
    cuda: str = ""
    """The CUDA it was built for; empty for a build for the CPU."""
    hip: str = ""
    """The ROCm it was built for."""
    error: str = ""
    """Why it cannot be imported."""
    available: bool | None = None
    """`torch.cuda.is_available()`; None: not tried, or no answer."""
    reason: str = ""
    """Its error when it was not available."""
    gpus: tuple[Gpu, ...] = ()
    """GPUs in torch's order; the first is the one that would be used."""
    architectures: tuple[str, ...] = ()
    """What its kernels were compiled for: sm_90, ..."""
    extensions: str = ""
    """Folder in which it keeps compiled extensions."""
    host_compilers: dict[str, list[int]] = field(default_factory=dict)
    """Version of nvcc -> first major version of gcc that is too new for it."""


@dataclass(frozen=True)
class Triton:
    """The compiler of our own GPU kernels."""

    version: str = ""
    """Empty if it cannot be imported where torch is."""
    wanted: str = ""
    """The requirement that torch names: "triton==3.7.1"; empty if it names none."""
    computes: bool | None = None
    """Whether it added two numbers on the GPU; None if that was not tried."""
    error: str = ""
    """Why it cannot be imported, or does not compute."""


@dataclass(frozen=True)
class Gsplat:
    """The gsplat library."""

    version: str = ""
    prebuilt: str = ""
    """Compiled extension that came with the package."""
    cached: str = ""
    """Extension that torch compiled on this machine."""
    loads: bool | None = None
    """Whether the extension can be loaded; None if there is none, or it was not tried."""
    error: str = ""
    """Why it cannot."""
    compile_seconds: float | None = None
    """Time of `--compile`; None without it."""
    compiled_by: str = ""
    """The nvcc that compiled `cached`, as it was spelled then."""
    current: bool | None = None
    """Whether ninja finds nothing to do in the folder of `cached`; None: not tried, or no answer."""


@dataclass(frozen=True)
class Toolkit:
    """The CUDA toolkit."""

    home: str = ""
    """Folder in which torch looks for it: CUDA_HOME, CUDA_PATH, the one of the nvcc on PATH, or /usr/local/cuda."""
    home_from: str = ""
    """The variable that named it, "PATH" or "default"."""
    nvcc: str = ""
    """Version of `home`/bin/nvcc."""
    error: str = ""
    """The error of nvcc."""
    headers: bool = False
    """Whether cuda_runtime.h is where a C++ compiler will look."""
    headers_elsewhere: str = ""
    """Folder below `home` that has it instead."""
    others: tuple[tuple[str, str], ...] = ()
    """Toolkits elsewhere that have nvcc and headers: (folder, version)."""
    libraries: str = ""
    """Folder to which torch sends the linker."""
    cudart: bool = False
    """Whether the linker finds libcudart.so, there or by itself."""
    cudart_name: str = ""
    """The library in `libraries` under its full name: "libcudart.so.13"."""
    pip: str = ""
    """Folder of NVIDIA's packages for CUDA 13 in this Python, which pip can make a toolkit."""


@dataclass(frozen=True)
class Builders:
    """Compilers for C++ and C, and what they need."""

    compiler: str = ""
    """The command: CXX, c++, or cl."""
    compiler_version: str = ""
    compiler_is_gcc: bool = False
    compiler_error: str = ""
    other_gcc: tuple[int, ...] = ()
    """Major versions N of commands g++-N."""
    c_compiler: str = ""
    """The command that Triton takes: CC, gcc or clang."""
    c_version: str = ""
    c_error: str = ""
    ninja: str = ""
    ninja_beside_python: str = ""
    """Folder of a ninja that is installed, but not on PATH."""
    python_headers: bool = False


@dataclass(frozen=True)
class Facts:
    """All facts. The default is a Linux machine with nothing on it."""

    system: System = field(default_factory=System)
    driver: Driver = field(default_factory=Driver)
    torch: Torch = field(default_factory=Torch)
    triton: Triton = field(default_factory=Triton)
    gsplat: Gsplat = field(default_factory=Gsplat)
    toolkit: Toolkit = field(default_factory=Toolkit)
    builders: Builders = field(default_factory=Builders)
    packages: dict[str, str] = field(default_factory=dict)
    """Optional Python package -> version, "" if it is not installed."""
    weights: dict[str, str] = field(default_factory=dict)
    """Scoring network -> where its weights are, "" if nowhere."""
    weights_error: str = ""
    variables: dict[str, str] = field(default_factory=dict)
    """Environment variables of ours and of CUDA that are set."""
