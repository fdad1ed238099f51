"""The command that fixes each thing: which build of torch, which toolkit, which package."""

from __future__ import annotations

import shlex
from pathlib import PurePath, PurePosixPath

from .records import Facts, number

WHEELS = "https://download.pytorch.org/whl"
LEAST_CAPABILITY = (7, 0)
"""gsplat uses cooperative groups by label, which older GPUs lack."""
LEAST_TORCH = (2, 4)
LEAST_GSPLAT = (1, 5, 3)
LEAST_GCC_FOR_13 = 10
"""With CUDA 13 torch compiles extensions as C++20."""
NVCC_FOR = {
    (8, 0): (11, 0), (8, 6): (11, 1), (8, 7): (11, 5), (8, 9): (11, 8), (9, 0): (11, 8), (10, 0): (12, 8),
    (10, 3): (12, 9), (12, 0): (12, 8), (12, 1): (12, 9),
}  # fmt: skip
"""Compute capability -> first nvcc that knows it."""


def torch_builds(facts: Facts) -> list[tuple[str, str]]:
    """Builds of torch that work with this driver and this GPU, best first: (CUDA, requirement for pip).

    A driver serves every minor version of its major one and all older ones (NVIDIA, "CUDA compatibility"). CUDA 13 has
    no kernels for GPUs before 7.5; the wheels for 12.6 and 11.8 have none for GPUs after 9.0; those for 12.8 end with
    torch 2.11, those for 11.8 with 2.7, which knows no Python after 3.13.
    """
    arch = capability(facts) or (8, 0)
    serves = number(facts.driver.cuda) or ((12, 6) if arch < (10,) else (13, 0))
    builds = []
    if arch < LEAST_CAPABILITY:
        return builds
    if serves >= (13,) and arch >= (7, 5):
        builds.append(("13.0", "torch"))
    if serves >= (12, 8) and arch >= (10,):
        builds.append(("12.8", "torch<2.12"))
    if serves >= (12,) and arch < (10,):
        builds.append(("12.6", "torch"))
    if serves >= (11,) and arch < (10,) and number(facts.system.python) < (3, 14):
        builds.append(("11.8", "torch<2.8"))
    nvcc = number(facts.toolkit.nvcc)
    if nvcc >= (12,) and supports_gpu(facts, facts.toolkit.nvcc):  # first those that fit the installed toolkit
        builds.sort(key=lambda build: number(build[0])[0] != nvcc[0])
    return builds


def capability(facts: Facts) -> tuple[int, int] | None:
    """compute capability of the GPU that would be used."""
    return next((gpu.capability for gpu in (*facts.torch.gpus, *facts.driver.gpus) if gpu.capability), None)


def install_torch(facts: Facts, major: int | None = None, again: bool = False) -> str:
    """The command that installs a torch for this driver and GPU, "" if there is none.

    Args:
        major: only builds for this CUDA.
        again: also the build for the CUDA that is there.
    """
    for cuda, torch in torch_builds(facts):
        if (major is None or number(cuda)[0] == major) and (again or cuda != facts.torch.cuda):
            vision = " torchvision" if facts.packages.get("torchvision") else ""
            install = f"pip install {shlex.quote(torch)}{vision} --index-url {WHEELS}/cu{cuda.replace('.', '')}"
            # pip takes an installed build for another CUDA, or none, as good enough.
            return f"pip uninstall -y torch{vision} && {install}" if facts.torch.version else install
    return ""


def install_driver(facts: Facts) -> str:
    """How to get NVIDIA's driver."""
    if facts.system.name == "Windows":
        return "install NVIDIA's driver, 580 or newer, from https://www.nvidia.com/drivers"
    if facts.system.container:
        return "install NVIDIA's driver, 580 or newer, on the host, and start the container with --gpus all"
    if "Ubuntu" in facts.system.release:
        return "sudo ubuntu-drivers install && sudo reboot"
    if facts.system.packages == "apt-get":
        return "sudo apt-get install nvidia-driver && sudo reboot (section non-free; 580 or newer is best)"
    return "install NVIDIA's driver, 580 or newer, from https://www.nvidia.com/drivers, and restart"


def planned_cuda(facts: Facts) -> str:
    """The CUDA of the installed torch, or of the one that `install_torch` would install; "" if neither."""
    served = facts.driver.cuda or capability(facts)
    return facts.torch.cuda or (next((cuda for cuda, _ in torch_builds(facts)), "") if served else "")


def install_toolkit(facts: Facts) -> str:
    """How to get an nvcc that fits torch and the GPU."""
    wanted = number(planned_cuda(facts))[:2]
    least = nvcc_needed(facts)
    version = ".".join(map(str, max(wanted, least if least[:1] == wanted[:1] else ())))
    if other := fitting_toolkit(facts):
        return set_variable(facts, "CUDA_HOME", other)
    if facts.system.name == "Windows":
        return f"winget install Nvidia.CUDA --version {version}"
    if pip_has_toolkit(facts):
        return pip_toolkit(facts, version)
    if facts.system.packages == "apt-get":
        name = f"cuda-toolkit-{version.replace('.', '-')}"
        return f"sudo apt-get install {name} (from NVIDIA's packages: https://developer.nvidia.com/cuda-downloads)"
    return f"install the CUDA toolkit {version} from https://developer.nvidia.com/cuda-toolkit-archive"


def pip_has_toolkit(facts: Facts) -> bool:
    """Whether NVIDIA's wheels for torch's CUDA make up a toolkit; those for 12 lie in a folder each."""
    return facts.system.name == "Linux" and number(planned_cuda(facts))[:1] == (13,)


def pip_toolkit(facts: Facts, version: str) -> str:
    """How to get a toolkit without root: NVIDIA's wheels beside those that torch brings, all of one minor version.

    Nvcc's wheel named alone would bring a newer one than the headers that are there.
    """
    install = f"pip install 'cuda-toolkit[nvcc,cccl]=={version}.*'"
    pip, home = facts.toolkit.pip, facts.toolkit.home
    return f"{install} && {set_variable(facts, 'CUDA_HOME', pip)}" if pip and pip != home else install


def link_cudart(facts: Facts) -> str:
    """How to make the link that the linker needs, which wheels leave out."""
    folder = PurePosixPath(facts.toolkit.libraries)
    return f"ln -sf {shlex.quote(facts.toolkit.cudart_name)} {shlex.quote(str(folder / 'libcudart.so'))}"


def fitting_toolkit(facts: Facts) -> str:
    """An installed toolkit of torch's CUDA in a place that torch does not search; "" if there is none."""
    wanted = number(planned_cuda(facts))
    fitting = [
        entry for entry in facts.toolkit.others if number(entry[1])[:1] == wanted[:1] and supports_gpu(facts, entry[1])
    ]
    same = [folder for folder, version in fitting if number(version) == wanted]
    return (same or [folder for folder, _ in fitting] or [""])[0]


def nvcc_needed(facts: Facts) -> tuple[int, ...]:
    """First nvcc that compiles for the GPU, () if any does."""
    arch = capability(facts) or (0, 0)
    return max((need for least, need in NVCC_FOR.items() if arch[0] == least[0] and arch >= least), default=())


def supports_gpu(facts: Facts, nvcc: str) -> bool:
    """Whether an nvcc of this version compiles for the GPU."""
    arch = capability(facts)
    return arch is None or (number(nvcc) >= nvcc_needed(facts) and not (number(nvcc) >= (13,) and arch < (7, 5)))


def install_compiler(facts: Facts) -> str:
    """How to get a C++ compiler."""
    if facts.system.name == "Windows":
        return "winget install Microsoft.VisualStudio.2022.BuildTools, then use its x64 Native Tools prompt"
    names = {"apt-get": "install g++", "dnf": "install gcc-c++", "zypper": "install gcc-c++", "pacman": "-S gcc"}
    manager = facts.system.packages
    return f"sudo {manager} {names[manager]}" if manager in names else "install g++"


def other_compiler(facts: Facts, least: int, too_new: int) -> str:
    """How to use a gcc of at least `least` and below `too_new`: an installed one, or one to install."""
    here = [major for major in facts.builders.other_gcc if least <= major < too_new]
    major = max(here, default=too_new - 1)
    use = f"export CC=gcc-{major} CXX=g++-{major}"
    if here:
        return use
    if facts.system.packages == "apt-get":
        return f"sudo apt-get install g++-{major} && {use}"
    return f"install g++ {major}, then {use}"


def install_python_headers(facts: Facts) -> str:
    """How to get Python.h."""
    short = ".".join(facts.system.python.split(".")[:2])
    if facts.system.packages == "apt-get":
        return f"sudo apt-get install python{short}-dev"
    if facts.system.packages == "dnf":
        return f"sudo dnf install python{short}-devel"
    return f"install the headers of Python {short}, or use a Python that has them"


def install_triton(facts: Facts) -> str:
    """How to get the Triton that torch was built with; "" where torch has none, which is on Windows."""
    if facts.system.name != "Linux":
        return ""
    if not facts.torch.cuda:
        return install_torch(facts) or install_driver(facts)
    return f"pip install {shlex.quote(facts.triton.wanted or 'triton')}"


def interprets(facts: Facts) -> bool:
    """Whether Triton is set to interpret kernels on the CPU."""
    return facts.variables.get("TRITON_INTERPRET", "").lower() in ("1", "true", "yes", "on", "y")


def fix_triton(facts: Facts) -> str:
    """How to fix a Triton that is installed and did not compute, by its error; "" if that is not known."""
    error, wanted = facts.triton.error, facts.triton.wanted
    if "libcuda" in error:
        return "sudo ldconfig; if that is not enough, export TRITON_LIBCUDA_PATH=(the folder of libcuda.so.1)"
    if "fatal error" in error:  # of the compiler: it lacks the headers of C
        return install_compiler(facts)
    if any(words in error for words in ("Permission denied", "Read-only", "No space")):
        return 'export TRITON_CACHE_DIR="$(mktemp -d)"'
    return install_triton(facts) if wanted and wanted != f"triton=={facts.triton.version}" else ""


def set_variable(facts: Facts, name: str, value: str) -> str:
    """The shell's command for an environment variable."""
    if facts.system.name == "Windows":
        return f"set {name}={value}"
    return f"export {name}={shlex.quote(value)}"


def unset_variable(facts: Facts, name: str) -> str:
    """The shell's command that removes an environment variable."""
    return f"set {name}=" if facts.system.name == "Windows" else f"unset {name}"


def use_ninja(facts: Facts) -> str:
    """How to get ninja onto PATH."""
    beside = facts.builders.ninja_beside_python
    if not beside:
        return "pip install ninja"
    if facts.system.name == "Windows":
        return f"set PATH={beside};%PATH%"
    return f'export PATH={shlex.quote(str(PurePath(beside)))}:"$PATH"'


def compile_again(facts: Facts) -> str:
    """Compile gsplat; what was compiled and does not load is removed first."""
    if not facts.gsplat.cached or facts.gsplat.loads is not False:
        return "endoprior doctor --compile"
    folder = str(PurePath(facts.gsplat.cached).parent)
    remove = f'rmdir /s /q "{folder}"' if facts.system.name == "Windows" else f"rm -r {shlex.quote(folder)}"
    return f"{remove} && endoprior doctor --compile"
