"""The lines of Triton, which needs no CUDA toolkit: a C compiler and Python.h, once."""

from __future__ import annotations

from . import fixes
from .lines import GpuBackend, Line, State
from .records import Facts


def triton_backend(facts: Facts) -> GpuBackend:
    """What Triton needs."""
    return GpuBackend((_c_compiler(facts), python_headers(facts), _triton(facts)))


def _line(name: str, state: State, found: str, fix: str = "") -> Line:
    return Line("triton", name, state, found, fix)


def _c_compiler(facts: Facts) -> Line:
    builders, name = facts.builders, "C compiler"
    if builders.c_version:
        return _line(name, "ok", f"{builders.c_compiler} {builders.c_version}")
    if facts.system.name == "Windows":  # Triton finds it in other ways there
        return _line(name, "ok", "not checked on Windows")
    if "CC" in facts.variables:  # Triton runs it as one word
        return _line(name, "wrong", f"{builders.c_error} (CC is set)", fixes.unset_variable(facts, "CC"))
    return _line(name, "missing", builders.c_error or "no gcc, no clang", fixes.install_compiler(facts))


def python_headers(facts: Facts) -> Line:
    """Whether C code can be compiled for this Python."""
    if facts.builders.python_headers:
        return _line("Python headers", "ok", "Python.h")
    return _line("Python headers", "missing", "no Python.h", fixes.install_python_headers(facts))


def _triton(facts: Facts) -> Line:
    triton, name = facts.triton, "Triton"
    if not triton.version:
        found = f"cannot be imported: {triton.error}" if triton.error else "not installed"
        found += "" if facts.torch.cuda else "; torch for CUDA brings it on Linux"
        return _line(name, "wrong" if triton.error else "missing", found, fixes.install_triton(facts))
    if fixes.interprets(facts):
        found = f"{triton.version}; TRITON_INTERPRET makes it run on the CPU"
        return _line(name, "wrong", found, fixes.unset_variable(facts, "TRITON_INTERPRET"))
    if triton.computes:
        return _line(name, "ok", f"{triton.version} adds two numbers on the GPU")
    if triton.computes is False:
        found = f"{triton.version}: {triton.error or 'it adds two numbers wrongly'}"
        return _line(name, "wrong", found, fixes.fix_triton(facts))
    if facts.torch.gpus and facts.torch.gpus[0].computes:
        return _line(name, "missing", f"{triton.version}, not tried", "endoprior doctor")
    return _line(name, "ok", triton.version)  # there is no GPU to try it on
