"""The lines of gsplat, the way to the GPU that compiles itself: with nvcc, a C++ compiler and ninja. Pure."""

from __future__ import annotations

import posixpath

from . import mend
from .lines import Line, State, Way
from .records import Facts, number
from .triton_lines import python_headers


def gsplat_way(facts: Facts) -> Way:
    """What gsplat needs. Its line about Python's headers is Triton's, which needs them too."""
    if facts.gsplat.prebuilt and facts.gsplat.loads:
        names = ("nvcc", "CUDA headers", "CUDA library", "C++ compiler", "ninja")
        tools = [_line(name, "ok", "not needed: gsplat came compiled") for name in names]
    else:
        tools = [link(facts) for link in (_nvcc, _headers, _library, _compiler, python_headers, _ninja)]
    return Way("gsplat", (_gsplat(facts), *tools, _compiled(facts)))


def _line(name: str, state: State, found: str, mend_: str = "") -> Line:
    return Line("gsplat", name, state, found, mend_)


def _gsplat(facts: Facts) -> Line:
    version = facts.gsplat.version
    if not version:
        return _line("gsplat", "missing", "not installed", "pip install 'endoprior[cuda]'")
    if number(version) and number(version) < mend.LEAST_GSPLAT:
        return _line("gsplat", "wrong", f"{version}; 1.5.3 or newer is needed", "pip install --upgrade 'gsplat>=1.5.3'")
    return _line("gsplat", "ok", version)


def _nvcc(facts: Facts) -> Line:
    toolkit, wanted = facts.toolkit, number(mend.planned_cuda(facts))
    if not toolkit.nvcc:
        named = toolkit.home_from in ("CUDA_HOME", "CUDA_PATH")
        stays = not named or toolkit.home == toolkit.pip  # else what it names is not where a toolkit will be
        repair = mend.install_toolkit(facts) if mend.fitting_toolkit(facts) or stays else ""
        found = toolkit.error or "no CUDA toolkit"
        found += f" ({toolkit.home_from} says so)" * named
        return _line(
            "nvcc", "wrong" if named else "missing", found, repair or mend.unset_variable(facts, toolkit.home_from)
        )
    words = f"{toolkit.nvcc} in {toolkit.home}"
    if wanted and number(toolkit.nvcc)[:1] != wanted[:1]:
        near = mend.fitting_toolkit(facts) or mend.pip_has_toolkit(facts)
        usable = mend.knows_card(facts, toolkit.nvcc) and number(toolkit.nvcc) >= (12,)  # 11 would mean an old torch
        other_torch = mend.install_torch(facts, number(toolkit.nvcc)[0]) if usable else ""
        repair = mend.install_toolkit(facts) if near or not other_torch else other_torch
        return _line("nvcc", "wrong", f"{words}; torch needs CUDA {mend.planned_cuda(facts)}", repair)
    if not mend.knows_card(facts, toolkit.nvcc):
        return _line("nvcc", "wrong", f"{words}; it does not know this GPU", mend.install_toolkit(facts))
    return _line("nvcc", "ok", words)


def _headers(facts: Facts) -> Line:
    toolkit, name = facts.toolkit, "CUDA headers"
    if toolkit.headers:
        return _line(name, "ok", "cuda_runtime.h")
    found = f"no cuda_runtime.h in {toolkit.home}/include" if toolkit.home else "no CUDA toolkit"
    if toolkit.headers_elsewhere:
        return _line(name, "wrong", found, mend.set_variable(facts, "CUDA_INC_PATH", toolkit.headers_elsewhere))
    return _line(name, "missing", found, mend.install_toolkit(facts))


def _library(facts: Facts) -> Line:
    toolkit, name = facts.toolkit, "CUDA library"
    if toolkit.cudart:
        return _line(name, "ok", "libcudart.so")
    if facts.gsplat.loads:
        return _line(name, "ok", "libcudart.so is not needed any more: gsplat is compiled")
    if not toolkit.home:
        return _line(name, "missing", "no CUDA toolkit", mend.install_toolkit(facts))
    if toolkit.cudart_name:
        found = f"{toolkit.cudart_name} in {toolkit.libraries}, but no link libcudart.so to it"
        return _line(name, "wrong", found, mend.link_cudart(facts))
    return _line(name, "missing", f"no libcudart.so in {toolkit.libraries}", mend.install_toolkit(facts))


def _compiler(facts: Facts) -> Line:
    builders, name = facts.builders, "C++ compiler"
    if not builders.compiler_version:
        return _line(name, "missing", builders.compiler_error or "none", mend.install_compiler(facts))
    words = f"{builders.compiler} {builders.compiler_version}"
    bound = facts.torch.host_compilers.get(facts.toolkit.nvcc, [])
    least = mend.LEAST_GCC_FOR_13 if number(mend.planned_cuda(facts)) >= (13,) else 0
    version = number(builders.compiler_version) if builders.compiler_is_gcc else ()
    if version and bound and version >= tuple(bound):
        found = f"{words}: too new for nvcc {facts.toolkit.nvcc}"
        return _line(name, "wrong", found, mend.other_compiler(facts, least, bound[0]))
    if version and version < (least,):
        found = f"{words}: too old for C++20, which torch for CUDA 13 needs"
        return _line(name, "wrong", found, mend.other_compiler(facts, least, bound[0] if bound else 13))
    return _line(name, "ok", words)


def _ninja(facts: Facts) -> Line:
    builders = facts.builders
    if builders.ninja:
        return _line("ninja", "ok", builders.ninja)
    if builders.ninja_beside_python:
        return _line("ninja", "wrong", f"in {builders.ninja_beside_python}, not on PATH", mend.use_ninja(facts))
    return _line("ninja", "missing", "not on PATH", mend.use_ninja(facts))


def _compiled(facts: Facts) -> Line:
    gsplat, name = facts.gsplat, "gsplat compiled"
    if gsplat.loads:
        if again := _compiles_again(facts):
            return _line(name, "missing", again, mend.compile_again(facts))
        how = "came compiled" if gsplat.prebuilt else "compiled on this machine"
        took = f", ready in {gsplat.compile_seconds:.0f} s" if gsplat.compile_seconds is not None else ""
        return _line(name, "ok", how + took)
    if gsplat.loads is None:
        found = "not tried" if gsplat.prebuilt or gsplat.cached else "not yet; takes minutes, once"
        return _line(name, "missing", found, mend.compile_again(facts))
    if gsplat.cached:
        return _line(name, "wrong", f"what was compiled does not work: {gsplat.error}", mend.compile_again(facts))
    if gsplat.prebuilt:
        return _line(name, "missing", f"it came compiled for another torch: {gsplat.error}", mend.compile_again(facts))
    return _line(name, "wrong", gsplat.error, 'VERBOSE=1 python -c "import gsplat.cuda._backend"')


def _compiles_again(facts: Facts) -> str:
    """Why what was compiled is compiled again at the next use, without a word; "" if nothing is known to cause it."""
    by, home = facts.gsplat.compiled_by, facts.toolkit.home
    if facts.gsplat.prebuilt:
        return ""
    # Ninja compares command lines, in which CUDA_HOME is spelled out. On Windows torch spells otherwise.
    if facts.system.name == "Linux" and by and home and by != posixpath.join(home, "bin", "nvcc"):
        return f"with {by}; it compiles again now that CUDA_HOME is {home}"
    if facts.gsplat.current is False:
        return "for another ninja, or before its sources changed; it compiles again"
    return ""
