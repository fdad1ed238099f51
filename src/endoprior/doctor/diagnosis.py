"""What works on a machine, and what to do next: decided from facts alone.

The GPU and torch come first; each line needs those before it. Then one backend, Triton or gsplat, is enough. The one
next step is the fix of the first line that is not ok, for the backend that needs fewer fixes.
"""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass, replace

from .gpu_lines import gpu_lines
from .gsplat_lines import gsplat_backend
from .lines import GpuBackend, Line
from .optional import machine_lines, optional_lines
from .records import Facts
from .triton_lines import triton_backend

NOTHING = "nothing"
COMPILED = "gsplat compiled"


@dataclass(frozen=True)
class Report:
    """Every line, and what follows for the GPU."""

    lines: tuple[Line, ...]
    triton: bool
    """Whether Triton works on the GPU."""
    gsplat: bool
    """Whether gsplat works on the GPU."""
    blocking: Line | None
    """The first line that is not ok; None if a backend works."""
    only_to_compile: bool
    """Whether gsplat lacks nothing but its own compilation, which it does at its first use."""
    has_usable_gpu: bool
    """False if there is no GPU, or none that could work."""
    compile_problem: str
    """Why gsplat cannot be compiled now, in one line; empty if it can. Compiling needs no GPU."""

    @property
    def broken(self) -> Line | None:
        """What keeps this computer from training even on the CPU; None if nothing does."""
        return next((line for line in self.lines if line.part == "machine" and line.state != "ok"), None)

    @property
    def verdict(self) -> str:
        """One sentence: whether this computer can train, and what of its GPU."""
        if self.broken:
            return f"This computer cannot train yet. {self.broken.name}: {self.broken.found}."
        can = "This computer can train and render."
        if self.works:
            return f"{can} It uses its GPU."
        if self.has_usable_gpu:
            return f"{can} GPU: not used yet; {self.blocking.name}: {self.blocking.found.rstrip('.')}."
        return f"{can} GPU: {self.blocking.found}; everything runs on the CPU."

    @property
    def works(self) -> bool:
        """Whether the GPU can be used."""
        return self.triton or self.gsplat

    @property
    def next_step(self) -> str:
        """The one thing to do next."""
        if self.blocking is None:
            backends = [name for name, works in (("Triton", self.triton), ("gsplat", self.gsplat)) if works]
            return f"{NOTHING}: CUDA works, with {' and '.join(backends)}"
        cpu = self.broken.fix if self.broken else f"{NOTHING} to install. Everything runs on the CPU."
        return self.blocking.fix or cpu


def examine(facts: Facts) -> Report:
    """Decide what works."""
    chain, backends = gpu_lines(facts), (triton_backend(facts), gsplat_backend(facts))
    easier = min(backends, key=lambda backend: backend.effort)  # of equals the first, Triton, which compiles in seconds
    has_usable_gpu = all(line.state == "ok" or line.fix for line in chain[:2])
    needs = _needs(backends, easier)
    compile_problem = _compile_problem(facts, chain, backends[1])
    if not has_usable_gpu:
        chain, needs = _without_fixes(chain), _without_fixes(needs)
    first = next((line for line in chain if line.state != "ok"), None)
    triton, gsplat = (first is None and backend.blocking is None for backend in backends)
    return Report(
        lines=(*machine_lines(facts), *chain, *needs, *optional_lines(facts)),
        triton=triton,
        gsplat=gsplat,
        blocking=first or easier.blocking,
        only_to_compile=first is None and _only_to_compile(backends[1]),
        has_usable_gpu=has_usable_gpu,
        compile_problem=compile_problem,
    )


def _needs(backends: tuple[GpuBackend, GpuBackend], easier: GpuBackend) -> tuple[Line, ...]:
    """Lines of both backends. Of the harder one only the first keeps its fix: one backend is enough."""
    lines = {line.name: line for backend in backends for line in backend.needs}.values()
    fixed = {line.name for line in easier.needs} | {backend.blocking.name for backend in backends if backend.blocking}
    return tuple(line if line.name in fixed else replace(line, fix="") for line in lines)


def _without_fixes(lines: Iterable[Line]) -> tuple[Line, ...]:
    return tuple(replace(line, fix="") for line in lines)


def _only_to_compile(gsplat: GpuBackend) -> bool:
    blocking = gsplat.blocking
    return blocking is not None and blocking.name == COMPILED and blocking.state == "missing"


def _compile_problem(facts: Facts, chain: Iterable[Line], gsplat: GpuBackend) -> str:
    """Nvcc needs no GPU, only its architecture: torch takes it from the GPU, or from TORCH_CUDA_ARCH_LIST."""
    wrong = [line for line in (*chain, *gsplat.needs) if line.state != "ok" and line.name != COMPILED]
    software = [line for line in wrong if line.name not in ("GPU", "driver", "CUDA in torch", "GPU computes")]
    named = facts.variables.get("TORCH_CUDA_ARCH_LIST", "") not in ("", "native")
    if software or (wrong and not named and facts.torch.available):
        first = (software or wrong)[0]
        return f"first fix {first.name}: {first.found}" + f"; {first.fix}" * bool(first.fix)
    if wrong and not named:
        return (
            "no GPU to compile for (torch would end in an IndexError). For an image, name the architecture: "
            "TORCH_CUDA_ARCH_LIST=9.0 endoprior doctor --compile"
        )
    return ""
