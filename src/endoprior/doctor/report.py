"""The report as a table for people and as JSON for programs."""

from __future__ import annotations

from dataclasses import asdict
from typing import Any

from .judge import Report
from .lines import Part
from .records import Facts

TITLES: dict[Part, str] = {
    "machine": "this machine",
    "cuda": "CUDA, in the order in which things must be right",
    "triton": "then Triton",
    "gsplat": "or gsplat",
    "also": "also, none of it needed",
}
OF_NO_USE = (
    "C compiler", "Python headers", "nvcc", "CUDA headers", "CUDA library", "C++ compiler", "ninja", "gsplat compiled",
)  # fmt: skip
"""What Triton and gsplat need; not shown where there is no GPU."""


def table(report: Report) -> list[str]:
    """Lines of text: state, what, found; below it the command that mends it."""
    width = max(len(line.name) for line in report.lines)
    rows = []
    for part in TITLES:
        rows += ["", _title(part, report)]
        for line in report.lines:
            if line.part == part and not (report.hopeless and line.name in OF_NO_USE):
                rows.append(f"  {line.state:<8}{line.name:<{width + 2}}{line.found}")
                rows += [f"  {'':<{width + 10}}-> {line.mend}"] if line.mend else []
    return rows[1:]


def _title(part: Part, report: Report) -> str:
    """The title of a part; of the two ways, also whether it works, and if not, whether that matters."""
    works = {"triton": report.triton, "gsplat": report.gsplat}
    if part not in works or report.hopeless:
        return TITLES[part]
    return TITLES[part] + (": works" if works[part] else ": not needed" if report.works else ": does not work yet")


def as_json(facts: Facts, report: Report, device: str, backend: str, why: str, compiling: str = "") -> dict[str, Any]:
    """Everything as JSON values; keys stay, new ones may come.

    Args:
        device, backend, why: what `--device auto` would use, and the reason.
        compiling: what came of `--compile`, where the lines do not tell.
    """
    return {
        "version": 2,
        "device": device,
        "backend": backend,
        "why": why,
        "cuda_works": report.works,
        "ways": {"triton": report.triton, "gsplat": report.gsplat},
        "only_to_compile": report.only_to_compile,
        "compiling": compiling,
        "blocking": report.blocking.name if report.blocking else None,
        "next_step": report.next_step,
        "lines": [asdict(line) for line in report.lines],
        "facts": asdict(facts),
    }
