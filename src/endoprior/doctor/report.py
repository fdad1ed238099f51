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
    "also": "optional parts",
}

GPU_PARTS: tuple[Part, ...] = ("cuda", "triton", "gsplat")


def table(report: Report) -> list[str]:
    """Lines of text: the verdict; then state, what, found, and below it the command that fixes it."""
    width = max(len(line.name) for line in report.lines if report.has_usable_gpu or line.part not in GPU_PARTS)
    rows = [report.verdict]
    for part in TITLES:
        if part in GPU_PARTS and not report.has_usable_gpu:
            continue
        rows += ["", _title(part, report)]
        if part == "also" and not report.has_usable_gpu:
            rows.append(f"  {'optional':<9}{'GPU':<{width + 2}}{_no_gpu(report.blocking)}")
        for line in (line for line in report.lines if line.part == part):
            row = f"  {line.state:<9}{line.name:<{width + 2}}{line.found}"
            if line.state == "optional":
                rows.append(f"{row} -> {line.fix}" if line.fix else row)
            else:
                rows += [row, f"  {'':<{width + 11}}-> {line.fix}"] if line.fix else [row]
    return rows


def _no_gpu(blocking: Line) -> str:
    """What is known of the GPU that is not used, in one line for all of its parts."""
    hint = "; start a container with `--gpus all` to use the host's GPU"
    return blocking.found + hint * (blocking.state == "missing")


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
        "version": 4,
        "verdict": report.verdict,
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
