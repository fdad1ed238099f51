"""Which device to compute on, decided once from facts and reported in one line."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal

from ..core.checks import InputError
from ..core.config import Backend
from . import Facts, Line, examine, read_facts, read_facts_quickly

Wanted = Literal["auto", "cpu", "cuda"]


@dataclass(frozen=True)
class Choice:
    """A device, the backend that renders on it, and why it was chosen."""

    device: Literal["cpu", "cuda"]
    backend: Backend
    why: str
    """One line for the user: "CPU: torch 2.13.0+cpu, built without CUDA"."""


def choose(wanted: Wanted, facts: Facts) -> Choice:
    """The device and the backend: gsplat where it works, else Triton where that works, else the CPU.

    Args:
        wanted: "auto" takes CUDA only where all of it works, and never compiles gsplat; "cuda" also where Triton does
            not work and gsplat compiles at its first use.
        facts: of this machine.
    Raises:
        InputError: "cuda" is wanted and does not work: the first thing that is wrong, and its fix.
    """
    if wanted == "cpu":
        return Choice("cpu", "numba", "CPU: as requested")
    report = examine(facts)
    gpu = facts.torch.gpus[0].name if facts.torch.gpus else "GPU"
    if report.gsplat:
        return Choice("cuda", "gsplat", f"CUDA: {gpu}, torch {facts.torch.version}, gsplat {facts.gsplat.version}")
    if report.triton:
        note = "; gsplat is not compiled" if report.only_to_compile else ""
        why = f"CUDA: {gpu}, torch {facts.torch.version}, Triton {facts.triton.version}{note}"
        return Choice("cuda", "triton", why)
    blocking = report.blocking
    if wanted == "cuda":
        if report.only_to_compile:
            return Choice("cuda", "gsplat", f"CUDA: {gpu}; gsplat first compiles itself, which takes minutes")
        fix = blocking.fix or "leave --device out to use the CPU"
        found = f"{blocking.name}: {blocking.found.rstrip('.')}"
        raise InputError(f"--device cuda: expected CUDA to work; got {found}. Fix: {fix}. See `endoprior doctor`.")
    if report.only_to_compile and blocking.part == "gsplat":
        return Choice("cpu", "numba", f"CPU: {gpu} is ready, but gsplat is not compiled; run `{blocking.fix}` once")
    return Choice("cpu", "numba", f"CPU: {_reason(blocking)}")


def _reason(line: Line) -> str:
    """What is missing, in words that can follow "CPU:"."""
    if line.name == "GPU" and line.state == "missing":
        return "no GPU found"
    if line.name in ("system", "GPU"):
        return line.found
    if line.part != "cuda":
        return f"the GPU is ready, but {line.name}: {line.found}; see `endoprior doctor`"
    return f"torch {line.found}" if line.name == "torch" else f"{line.name}: {line.found}"


def choose_here(wanted: Wanted) -> Choice:
    """`choose` on this machine. Without a GPU "auto" takes milliseconds; else it takes seconds, as "cuda" does.

    Raises:
        InputError: as `choose`.
    """
    if wanted == "cpu":
        return choose(wanted, Facts())
    if wanted == "auto":
        facts = read_facts_quickly()
        # These lines are already certain; the later ones are not.
        blocking = examine(facts).blocking
        if blocking is not None and blocking.name in ("system", "GPU", "driver", "torch"):
            return choose(wanted, facts)
    return choose(wanted, read_facts())  # "cuda" needs all facts, to name the fix
