"""The lines of gsplat, which compiles itself with nvcc, a C++ compiler and ninja."""

from __future__ import annotations

import posixpath

from ..core.extras import install_command
from . import fixes
from .lines import GpuBackend, Line, State
from .records import Facts, number
from .triton_lines import python_headers


def gsplat_backend(facts: Facts) -> GpuBackend:
    """What gsplat needs. Python's headers have one line for both backends."""
    if facts.gsplat.prebuilt and facts.gsplat.loads:
        names = ("nvcc", "CUDA headers", "CUDA library", "C++ compiler", "ninja")
        tools = [_line(name, "ok", "not needed: gsplat is precompiled") for name in names]
    else:
        tools = [link(facts) for link in (_nvcc, _headers, _library, _compiler, python_headers, _ninja)]
    return GpuBackend((_gsplat(facts), *tools, _compiled(facts)))


def _line(name: str, state: State, found: str, fix: str = "") -> Line:
    return Line("gsplat", name, state, found, fix)


def _gsplat(facts: Facts) -> Line:
    version = facts.gsplat.version
    if not version:
        return _line("gsplat", "missing", "not installed", install_command("cuda"))
    if number(version) and number(version) < fixes.LEAST_GSPLAT:
        return _line("gsplat", "wrong", f"{version}; 1.5.3 or newer is needed", "pip install --upgrade 'gsplat>=1.5.3'")
    return _line("gsplat", "ok", version)


def _nvcc(facts: Facts) -> Line:
    toolkit, wanted = facts.toolkit, number(fixes.planned_cuda(facts))
    if not toolkit.nvcc:
        named = toolkit.home_from in ("CUDA_HOME", "CUDA_PATH")
        stays = not named or toolkit.home == toolkit.pip  # else the variable does not name where a toolkit will be
        repair = fixes.install_toolkit(facts) if fixes.fitting_toolkit(facts) or stays else ""
        found = toolkit.error or "no CUDA toolkit"
        found += f" ({toolkit.home_from} is set)" * named
        return _line(
            "nvcc", "wrong" if named else "missing", found, repair or fixes.unset_variable(facts, toolkit.home_from)
        )
    words = f"{toolkit.nvcc} in {toolkit.home}"
    if wanted and number(toolkit.nvcc)[:1] != wanted[:1]:
        near = fixes.fitting_toolkit(facts) or fixes.pip_has_toolkit(facts)
        usable = fixes.supports_gpu(facts, toolkit.nvcc) and number(toolkit.nvcc) >= (12,)  # 11 would mean an old torch
        other_torch = fixes.install_torch(facts, number(toolkit.nvcc)[0]) if usable else ""
        repair = fixes.install_toolkit(facts) if near or not other_torch else other_torch
        return _line("nvcc", "wrong", f"{words}; torch needs CUDA {fixes.planned_cuda(facts)}", repair)
    if not fixes.supports_gpu(facts, toolkit.nvcc):
        return _line("nvcc", "wrong", f"{words}; it does not support this GPU", fixes.install_toolkit(facts))
    return _line("nvcc", "ok", words)


def _headers(facts: Facts) -> Line:
    toolkit, name = facts.toolkit, "CUDA headers"
    if toolkit.headers:
        return _line(name, "ok", "cuda_runtime.h")
    found = f"no cuda_runtime.h in {toolkit.home}/include" if toolkit.home else "no CUDA toolkit"
    if toolkit.headers_elsewhere:
        return _line(name, "wrong", found, fixes.set_variable(facts, "CUDA_INC_PATH", toolkit.headers_elsewhere))
    return _line(name, "missing", found, fixes.install_toolkit(facts))


def _library(facts: Facts) -> Line:
    toolkit, name = facts.toolkit, "CUDA library"
    if toolkit.cudart:
        return _line(name, "ok", "libcudart.so")
    if facts.gsplat.loads:
        return _line(name, "ok", "libcudart.so is not needed any more: gsplat is compiled")
    if not toolkit.home:
        return _line(name, "missing", "no CUDA toolkit", fixes.install_toolkit(facts))
    if toolkit.cudart_name:
        found = f"{toolkit.cudart_name} in {toolkit.libraries}, but no link libcudart.so to it"
        return _line(name, "wrong", found, fixes.link_cudart(facts))
    return _line(name, "missing", f"no libcudart.so in {toolkit.libraries}", fixes.install_toolkit(facts))


def _compiler(facts: Facts) -> Line:
    builders, name = facts.builders, "C++ compiler"
    if not builders.compiler_version:
        return _line(name, "missing", builders.compiler_error or "none", fixes.install_compiler(facts))
    words = f"{builders.compiler} {builders.compiler_version}"
    bound = facts.torch.host_compilers.get(facts.toolkit.nvcc, [])
    least = fixes.LEAST_GCC_FOR_13 if number(fixes.planned_cuda(facts)) >= (13,) else 0
    version = number(builders.compiler_version) if builders.compiler_is_gcc else ()
    if version and bound and version >= tuple(bound):
        found = f"{words}: too new for nvcc {facts.toolkit.nvcc}"
        return _line(name, "wrong", found, fixes.other_compiler(facts, least, bound[0]))
    if version and version < (least,):
        found = f"{words}: too old for C++20, which torch for CUDA 13 needs"
        return _line(name, "wrong", found, fixes.other_compiler(facts, least, bound[0] if bound else 13))
    return _line(name, "ok", words)


def _ninja(facts: Facts) -> Line:
    builders = facts.builders
    if builders.ninja:
        return _line("ninja", "ok", builders.ninja)
    if builders.ninja_beside_python:
        return _line("ninja", "wrong", f"in {builders.ninja_beside_python}, not on PATH", fixes.use_ninja(facts))
    return _line("ninja", "missing", "not on PATH", fixes.use_ninja(facts))


def _compiled(facts: Facts) -> Line:
    gsplat, name = facts.gsplat, "gsplat compiled"
    if gsplat.loads:
        if again := _compiles_again(facts):
            return _line(name, "missing", again, fixes.compile_again(facts))
        how = "precompiled" if gsplat.prebuilt else "compiled on this machine"
        took = f", ready in {gsplat.compile_seconds:.0f} s" if gsplat.compile_seconds is not None else ""
        return _line(name, "ok", how + took)
    if gsplat.loads is None:
        found = "not tried" if gsplat.prebuilt or gsplat.cached else "not yet; takes minutes, once"
        return _line(name, "missing", found, fixes.compile_again(facts))
    if gsplat.cached:
        return _line(name, "wrong", f"what was compiled does not work: {gsplat.error}", fixes.compile_again(facts))
    if gsplat.prebuilt:
        return _line(name, "missing", f"precompiled for another torch: {gsplat.error}", fixes.compile_again(facts))
    return _line(name, "wrong", gsplat.error, 'VERBOSE=1 python -c "import gsplat.cuda._backend"')


def _compiles_again(facts: Facts) -> str:
    """Why gsplat compiles again at its next use, without a message; "" if nothing is known to cause it."""
    by, home = facts.gsplat.compiled_by, facts.toolkit.home
    if facts.gsplat.prebuilt:
        return ""
    # Ninja compares command lines, in which CUDA_HOME is spelled out. On Windows torch spells otherwise.
    if facts.system.name == "Linux" and by and home and by != posixpath.join(home, "bin", "nvcc"):
        return f"with {by}; it compiles again because CUDA_HOME is now {home}"
    if facts.gsplat.current is False:
        return "for another ninja, or before its sources changed; it compiles again"
    return ""
