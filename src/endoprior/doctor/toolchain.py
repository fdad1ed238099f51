"""What compiles: nvcc where torch looks for it, compilers for C++ and C, ninja, Python's headers."""

from __future__ import annotations

import importlib.util
import os
import re
import shutil
import sys
import sysconfig
from pathlib import Path

from .probe_process import clean, run_program
from .records import Builders, Toolkit

LIMIT_S = 10.0
WINDOWS = os.name == "nt"
SUFFIX = ".exe" if WINDOWS else ""
CUDART = "cudart.lib" if WINDOWS else "libcudart.so"
"""What gsplat is linked against; wheels have it only under its full name, with a version behind."""


def find_toolkit(default: Path = Path("/usr/local/cuda"), limit_s: float = LIMIT_S) -> Toolkit:
    """The CUDA toolkit that torch's extension compiler would take, and others beside it.

    Args:
        default: folder taken when neither variables nor PATH name one; toolkits called like it with a version after a
            dash are the others, and one that pip installed.
    """
    home, home_from = _home(default)
    pip = pip_folder()
    places = [*sorted(default.parent.glob(f"{default.name}-*")), *[Path(pip)] * bool(pip)]
    others = tuple(
        (str(folder), version)
        for folder in places
        if str(folder) != home and _has_headers(folder) and (version := _nvcc(folder, limit_s)[0])
    )
    if not home:
        return Toolkit(others=others, pip=pip)
    nvcc, error = _nvcc(Path(home), limit_s)
    elsewhere = next((file.parent for file in sorted(Path(home).glob("targets/*/include/cuda_runtime.h"))), "")
    libraries = _libraries(Path(home))
    return Toolkit(
        home=home,
        home_from=home_from,
        nvcc=nvcc,
        error=error,
        headers=_has_headers(Path(home), searched=True),
        headers_elsewhere=str(elsewhere),
        others=others,
        libraries=str(libraries),
        cudart=(libraries / CUDART).exists() or _linker_finds(CUDART, limit_s),
        cudart_name=next((file.name for file in sorted(libraries.glob(f"{CUDART}.*"))), ""),
        pip=pip,
    )


def find_builders(limit_s: float = LIMIT_S) -> Builders:
    """The compilers that torch and Triton would take, ninja, and Python's headers."""
    compiler = _cxx()
    version, is_gcc, error = _compiler(compiler.split(), limit_s)  # CXX may be "ccache g++"
    c_compiler = _cc()
    c_version, _, c_error = _compiler([c_compiler], limit_s) if c_compiler else ("", False, "no gcc, no clang on PATH")
    beside = Path(sys.executable).parent
    ninja = run_program(["ninja", "--version"], limit_s)
    headers = sysconfig.get_path("include", "nt" if WINDOWS else "posix_prefix")  # Debian's own scheme names others
    return Builders(
        compiler=clean(compiler, 80),
        compiler_version=version,
        compiler_is_gcc=is_gcc,
        compiler_error=error,
        other_gcc=tuple(major for major in range(7, 30) if shutil.which(f"g++-{major}")),
        c_compiler=clean(Path(c_compiler).name, 80),
        c_version=c_version,
        c_error=c_error,
        ninja="" if ninja.problem else _version(ninja.text),
        ninja_beside_python=str(beside) if (beside / f"ninja{SUFFIX}").is_file() else "",
        python_headers=(Path(headers) / "Python.h").is_file(),
    )


def pip_folder() -> str:
    """Folder in which pip puts NVIDIA's packages for CUDA 13, the libraries of torch among them; "" if it is not there.

    Torch does not look for a toolkit in it.
    """
    spec = importlib.util.find_spec("nvidia")
    folders = [Path(place) / "cu13" for place in (spec.submodule_search_locations if spec else None) or ()]
    return next((str(folder) for folder in folders if folder.is_dir()), "")


def _cxx() -> str:
    return os.environ.get("CXX") or ("cl" if WINDOWS else "c++")


def _cc() -> str:
    """The C compiler in Triton's order (triton.runtime.build), which takes CC as one word, an empty one too."""
    named = os.environ.get("CC")
    return named if named is not None else next(filter(None, map(shutil.which, ("gcc", "clang"))), "")


def _libraries(home: Path) -> Path:
    """Folder to which torch sends the linker (torch.utils.cpp_extension._prepare_ldflags)."""
    if WINDOWS:
        return home / "lib" / "x64"
    return home / "lib" if not (home / "lib64").exists() and (home / "lib").exists() else home / "lib64"


def _linker_finds(name: str, limit_s: float) -> bool:
    """Whether a library is where the linker looks by itself, as Debian's packages put it, or LIBRARY_PATH does."""
    answer = run_program([*_cxx().split(), f"-print-file-name={name}"], limit_s)
    return not answer.problem and os.path.isabs(answer.text.strip()) and Path(answer.text.strip()).exists()


def _home(default: Path) -> tuple[str, str]:
    """Folder and where it came from, in torch's order (torch.utils.cpp_extension._find_cuda_home); links stay links."""
    for name in ("CUDA_HOME", "CUDA_PATH"):
        if value := os.environ.get(name):
            return value, name
    if nvcc := shutil.which("nvcc"):
        return str(Path(nvcc).parent.parent), "PATH"
    return (str(default), "default") if default.is_dir() else ("", "")


def _nvcc(home: Path, limit_s: float) -> tuple[str, str]:
    """Version of the nvcc in a toolkit, or why there is none."""
    program = home / "bin" / f"nvcc{SUFFIX}"
    if not program.is_file():
        return "", f"no {program}"
    answer = run_program([str(program), "--version"], limit_s)
    found = re.search(r"release (\d+\.\d+)", answer.text)
    if answer.problem or not found:
        return "", answer.problem or f"{program} printed no version: {clean(answer.text, 80)}"
    return found[1], ""


def _has_headers(home: Path, searched: bool = False) -> bool:
    """Whether cuda_runtime.h is in the folder's include, or, if `searched`, where variables send the compiler."""
    places = [home / "include"]
    if searched:
        named = [os.environ.get("CUDA_INC_PATH", ""), *os.environ.get("CPATH", "").split(os.pathsep)]
        places += [Path(name) for name in named if name]
    return any((place / "cuda_runtime.h").is_file() for place in places)


def _compiler(words: list[str], limit_s: float) -> tuple[str, bool, str]:
    """Version, whether it is gcc, and why there is none."""
    if not words or not shutil.which(words[0]):
        return "", False, f"no {clean(' '.join(words), 80) or 'compiler'} on PATH"
    if Path(words[0]).stem.lower() == "cl":  # prints its version and an error; it has no option for it
        answer = run_program(words, limit_s)
        return _version(answer.text) or "?", False, ""
    answer = run_program([*words, "--version"], limit_s)
    if answer.problem:
        return "", False, answer.problem
    version = _version(answer.text.splitlines()[0] if answer.text.strip() else "")
    if not version:
        return "", False, f"{words[0]} printed no version: {clean(answer.text, 80)}"
    # Clang says so; "Free Software Foundation" is in gcc's own page, whatever the command is called.
    return version, "Free Software Foundation" in answer.text and "clang" not in answer.text, ""


def _version(text: str) -> str:
    """The last version-like number of a line: gcc puts the distribution's in brackets before it."""
    found = re.findall(r"(?<![\d.])\d+(?:\.\d+)+", re.sub(r"\([^)]*\)", " ", text))
    return found[0] if found else ""
