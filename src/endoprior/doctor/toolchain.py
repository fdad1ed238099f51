"""What gsplat needs to compile itself: nvcc where torch looks for it, a C++ compiler, ninja, Python's headers."""

from __future__ import annotations

import os
import re
import shutil
import sys
import sysconfig
from pathlib import Path

from .ask import ask, clean
from .records import Builders, Toolkit

LIMIT_S = 10.0
WINDOWS = os.name == "nt"
SUFFIX = ".exe" if WINDOWS else ""


def look_for_toolkit(default: Path = Path("/usr/local/cuda"), limit_s: float = LIMIT_S) -> Toolkit:
    """The CUDA toolkit that torch's extension compiler would take, and others beside it.

    Args:
        default: folder taken when neither variables nor PATH name one; toolkits called like it with a version after a
            dash are the others.
    """
    home, home_from = _home(default)
    others = tuple(
        (str(folder), version)
        for folder in sorted(default.parent.glob(f"{default.name}-*"))
        if str(folder) != home and _has_headers(folder) and (version := _nvcc(folder, limit_s)[0])
    )
    if not home:
        return Toolkit(others=others)
    nvcc, error = _nvcc(Path(home), limit_s)
    elsewhere = next((file.parent for file in sorted(Path(home).glob("targets/*/include/cuda_runtime.h"))), "")
    return Toolkit(home, home_from, nvcc, error, _has_headers(Path(home), searched=True), str(elsewhere), others)


def look_for_builders(limit_s: float = LIMIT_S) -> Builders:
    """The C++ compiler that torch would take, ninja, and Python's headers."""
    compiler = os.environ.get("CXX") or ("cl" if WINDOWS else "c++")
    version, is_gcc, error = _compiler(compiler, limit_s)
    beside = Path(sys.executable).parent
    ninja = ask(["ninja", "--version"], limit_s)
    return Builders(
        compiler=clean(compiler, 80),
        compiler_version=version,
        compiler_is_gcc=is_gcc,
        compiler_error=error,
        other_gcc=tuple(major for major in range(7, 30) if shutil.which(f"g++-{major}")),
        ninja="" if ninja.problem else _version(ninja.text),
        ninja_beside_python=str(beside) if (beside / f"ninja{SUFFIX}").is_file() else "",
        python_headers=(Path(sysconfig.get_paths()["include"]) / "Python.h").is_file(),
    )


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
    said = ask([str(program), "--version"], limit_s)
    found = re.search(r"release (\d+\.\d+)", said.text)
    if said.problem or not found:
        return "", said.problem or f"{program} printed no version: {clean(said.text, 80)}"
    return found[1], ""


def _has_headers(home: Path, searched: bool = False) -> bool:
    """Whether cuda_runtime.h is in the folder's include, or, if `searched`, where variables send the compiler."""
    places = [home / "include"]
    if searched:
        named = [os.environ.get("CUDA_INC_PATH", ""), *os.environ.get("CPATH", "").split(os.pathsep)]
        places += [Path(name) for name in named if name]
    return any((place / "cuda_runtime.h").is_file() for place in places)


def _compiler(command: str, limit_s: float) -> tuple[str, bool, str]:
    """Version, whether it is gcc, and why there is none."""
    words = command.split()  # CXX may be "ccache g++"
    if not words or not shutil.which(words[0]):
        return "", False, f"no {clean(command, 80)} on PATH"
    if Path(words[0]).stem.lower() == "cl":  # prints its version and complains; there is nothing else to ask
        said = ask(words, limit_s)
        return _version(said.text) or "?", False, ""
    said = ask([*words, "--version"], limit_s)
    if said.problem:
        return "", False, said.problem
    version = _version(said.text.splitlines()[0] if said.text.strip() else "")
    if not version:
        return "", False, f"{words[0]} printed no version: {clean(said.text, 80)}"
    # Clang says so; "Free Software Foundation" is in gcc's own page, whatever the command is called.
    return version, "Free Software Foundation" in said.text and "clang" not in said.text, ""


def _version(text: str) -> str:
    """The last version-like number of a line: gcc puts the distribution's in brackets before it."""
    found = re.findall(r"(?<![\d.])\d+(?:\.\d+)+", re.sub(r"\([^)]*\)", " ", text))
    return found[0] if found else ""
