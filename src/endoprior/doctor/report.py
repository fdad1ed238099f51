"""The report as a table for people and as JSON for programs."""

from __future__ import annotations

from dataclasses import asdict
from typing import Any

from .diagnosis import Report
from .lines import Line, Part
from .records import Facts

TITLES: dict[Part, str] = {
    "machine": "this machine",
    "cuda": "GPU and PyTorch, each line needs those above",
    "triton": "Triton",
    "gsplat": "gsplat",
    "also": "optional",
}


def table(report: Report) -> list[str]:
    """Lines of text: state, what, found; below it the command that fixes it."""
    width = max(len(line.name) for line in report.lines)
    rows = []
    for part in TITLES:
        lines = [line for line in report.lines if line.part == part]
        if part in ("cuda", "triton", "gsplat") and not report.has_usable_gpu:
            rows += ["", *_no_gpu(report.blocking)] if part == "cuda" else []
            continue
        rows += ["", _title(part, report)]
        for line in lines:
            rows.append(f"  {line.state:<8}{line.name:<{width + 2}}{line.found}")
            rows += [f"  {'':<{width + 10}}-> {line.fix}"] if line.fix else []
    return rows[1:]


def _no_gpu(blocking: Line) -> list[str]:
    rows = [f"{blocking.name}: {blocking.found}. Everything runs on the CPU."]
    hint = "(In a container, start it with `--gpus all` to use the host's GPU.)"
    return [*rows, hint] if blocking.state == "missing" else rows


def _title(part: Part, report: Report) -> str:
    """The title of a part; of a backend also whether it works, and if not, whether it is needed."""
    works = {"triton": report.triton, "gsplat": report.gsplat}
    if part not in works:
        return TITLES[part]
    return TITLES[part] + (": works" if works[part] else ": not needed" if report.works else ": does not work yet")


def as_json(facts: Facts, report: Report, device: str, backend: str, why: str, compiling: str = "") -> dict[str, Any]:
    """Everything as JSON values; keys stay, new ones may come.

    Args:
        device, backend, why: what `--device auto` would use, and the reason.
        compiling: the result of `--compile`, where the lines do not tell it.
    """
    return {
        "version": 3,
        "device": device,
        "backend": backend,
        "why": why,
        "cuda_works": report.works,
        "backends": {"triton": report.triton, "gsplat": report.gsplat},
        "only_to_compile": report.only_to_compile,
        "compiling": compiling,
        "blocking": report.blocking.name if report.blocking else None,
        "next_step": report.next_step,
        "lines": [asdict(line) for line in report.lines],
        "facts": asdict(facts),
    }
