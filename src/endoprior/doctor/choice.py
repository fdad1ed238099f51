"""Which device to compute on, decided once from facts and reported in one line."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal

from ..core.checks import InputError
from . import Facts, Line, examine, glance, look

Wanted = Literal["auto", "cpu", "cuda"]


@dataclass(frozen=True)
class Choice:
    """A device, what draws on it, and why it was taken."""

    device: Literal["cpu", "cuda"]
    backend: Literal["cpu", "cuda", "triton"]
    """The rasterizer of `render.load`."""
    why: str
    """One line for the user: "CPU: torch 2.13.0+cpu, built without CUDA"."""


def choose(wanted: Wanted, facts: Facts) -> Choice:
    """The device and the rasterizer to use: gsplat where it works, else Triton where that works.

    Args:
        wanted: "auto" takes CUDA only where all of it was seen to work, and never has gsplat compile; "cuda" also where
            Triton does not work and gsplat has yet to compile itself at its first use.
        facts: of this machine.
    Raises:
        InputError: "cuda" was asked for and cannot be had: the first thing that is wrong, and its mend.
    """
    if wanted == "cpu":
        return Choice("cpu", "cpu", "CPU: as asked")
    report = examine(facts)
    card = facts.torch.gpus[0].name if facts.torch.gpus else "GPU"
    if report.gsplat:
        return Choice("cuda", "cuda", f"CUDA: {card}, torch {facts.torch.version}, gsplat {facts.gsplat.version}")
    if report.triton:
        instead = "; gsplat is not compiled" if report.only_to_compile else ""
        found = f"CUDA: {card}, torch {facts.torch.version}, Triton {facts.triton.version}{instead}"
        return Choice("cuda", "triton", found)
    blocking = report.blocking
    if wanted == "cuda":
        if report.only_to_compile:
            return Choice("cuda", "cuda", f"CUDA: {card}; gsplat compiles itself first, which takes minutes")
        first = f"{blocking.name}: {blocking.found.rstrip('.')}"
        step = f"Mend it: {blocking.mend}" if blocking.mend else "Leave --device out"
        raise InputError(f"--device cuda: expected CUDA to work; got {first}. {step}; `endoprior doctor` tells more.")
    if report.only_to_compile and blocking.part == "gsplat":
        return Choice("cpu", "cpu", f"CPU: {card} is ready, but gsplat is not compiled; run `{blocking.mend}` once")
    return Choice("cpu", "cpu", f"CPU: {_sentence(blocking)}")


def _sentence(line: Line) -> str:
    """What is missing, in words that can follow "CPU:"."""
    if line.name in ("system", "GPU"):
        return line.found.split(";")[0]
    if line.part != "cuda":
        return f"the GPU is ready, but {line.name}: {line.found}; see `endoprior doctor`"
    return f"torch {line.found}" if line.name == "torch" else f"{line.name}: {line.found}"


def choose_here(wanted: Wanted) -> Choice:
    """`choose` on this machine. Where there is no GPU, "auto" takes milliseconds; else both take seconds.

    Raises:
        InputError: as `choose`.
    """
    if wanted == "cpu":
        return choose(wanted, Facts())
    if wanted == "auto":
        facts = glance()
        # What a glance sees wrong up to the build of torch is wrong; of what comes after it saw nothing.
        blocking = examine(facts).blocking
        if blocking is not None and blocking.name in ("system", "GPU", "driver", "torch"):
            return choose(wanted, facts)
    return choose(wanted, look())  # who asks for CUDA is told what mends it, which takes all facts
