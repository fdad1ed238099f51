"""Decide from facts what works and what to do next. Pure: nothing here looks at the machine.

The GPU and torch are a chain: each link needs those before it. On from there lead two ways, Triton and gsplat, and one
of them is enough. The first thing that is not right, on the shorter way, is the one next step.
"""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass, replace

from .gpu_lines import gpu_lines
from .gsplat_lines import gsplat_way
from .lines import Line, Way
from .optional import machine_lines, optional_lines
from .records import Facts
from .triton_lines import triton_way

NOTHING = "nothing"
COMPILED = "gsplat compiled"


@dataclass(frozen=True)
class Report:
    """Every line, and what follows for the GPU."""

    lines: tuple[Line, ...]
    triton: bool
    """Whether the GPU can be used through Triton."""
    gsplat: bool
    """Whether it can be used through gsplat."""
    blocking: Line | None
    """The first thing that is not right, on the shorter way; None if one of them works."""
    only_to_compile: bool
    """Whether all that gsplat lacks is that it compiles itself, which it does at its first use."""
    hopeless: bool
    """Whether there is no GPU, or none that could work: what the ways need is then of no use."""
    hinders_compiling: str
    """Why gsplat cannot be compiled now, in one line; empty if it can, which without a GPU is as well possible."""

    @property
    def works(self) -> bool:
        """Whether the GPU can be used."""
        return self.triton or self.gsplat

    @property
    def next_step(self) -> str:
        """The one thing to do next."""
        if self.blocking is None:
            ways = [name for name, works in (("Triton", self.triton), ("gsplat", self.gsplat)) if works]
            return f"{NOTHING}: CUDA works, by {' and by '.join(ways)}"
        return self.blocking.mend or f"{NOTHING} to install: {self.blocking.found}"


def examine(facts: Facts) -> Report:
    """Judge a machine."""
    chain, ways = gpu_lines(facts), (triton_way(facts), gsplat_way(facts))
    shorter = min(ways, key=lambda way: way.effort)  # of equals the first, Triton, which compiles in seconds
    hopeless = any(line.state != "ok" and not line.mend for line in chain[:2])
    needs = _needs(ways, shorter)
    hinders = _hinders_compiling(facts, chain, ways[1])
    if hopeless:
        chain, needs = (*_unmended(chain[:2]), *_of_no_use(chain[2:])), _of_no_use(needs)
    first = next((line for line in chain if line.state != "ok"), None)
    triton, gsplat = (first is None and way.blocking is None for way in ways)
    return Report(
        lines=(*machine_lines(facts), *chain, *needs, *optional_lines(facts)),
        triton=triton,
        gsplat=gsplat,
        blocking=first or shorter.blocking,
        only_to_compile=first is None and _only_to_compile(ways[1]),
        hopeless=hopeless,
        hinders_compiling=hinders,
    )


def _needs(ways: tuple[Way, Way], shorter: Way) -> tuple[Line, ...]:
    """Lines of both ways; of the longer one only the first is mended: nobody has to go it."""
    lines = {line.name: line for way in ways for line in way.needs}.values()
    mended = {line.name for line in shorter.needs} | {way.blocking.name for way in ways if way.blocking}
    return tuple(line if line.name in mended else replace(line, mend="") for line in lines)


def _unmended(lines: Iterable[Line]) -> tuple[Line, ...]:
    return tuple(replace(line, mend="") for line in lines)


def _of_no_use(lines: Iterable[Line]) -> tuple[Line, ...]:
    """Where there is no GPU it is not wrong to be without the rest, and nothing mends it."""
    return tuple(replace(line, state="ok" if line.state == "ok" else "missing") for line in _unmended(lines))


def _only_to_compile(gsplat: Way) -> bool:
    blocking = gsplat.blocking
    return blocking is not None and blocking.name == COMPILED and blocking.state == "missing"


def _hinders_compiling(facts: Facts, chain: Iterable[Line], gsplat: Way) -> str:
    """Nvcc needs no GPU, only to know for which one: torch asks the one that is here, or TORCH_CUDA_ARCH_LIST."""
    wrong = [line for line in (*chain, *gsplat.needs) if line.state != "ok" and line.name != COMPILED]
    software = [line for line in wrong if line.name not in ("GPU", "driver", "CUDA in torch", "GPU computes")]
    named = facts.variables.get("TORCH_CUDA_ARCH_LIST", "") not in ("", "native")
    if software or (wrong and not named and facts.torch.available):
        first = (software or wrong)[0]
        return f"first mend {first.name}: {first.found}" + f"; {first.mend}" * bool(first.mend)
    if wrong and not named:
        return (
            "it compiles for the GPU it sees, and there is none (torch would end in an IndexError); for an image, name "
            "the GPU: TORCH_CUDA_ARCH_LIST=9.0 endoprior doctor --compile"
        )
    return ""
