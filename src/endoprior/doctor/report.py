"""The report as a table for people and as JSON for programs."""

from __future__ import annotations

from dataclasses import asdict
from typing import Any

from .judge import Report
from .records import Facts

TITLES = {
    "machine": "this machine",
    "cuda": "CUDA, in the order in which things must be right",
    "also": "also, none of it needed",
}


def table(report: Report) -> list[str]:
    """Lines of text: state, what, found; below it the command that mends it."""
    width = max(len(line.name) for line in report.lines)
    rows = []
    for part, title in TITLES.items():
        rows += ["", title]
        for line in report.lines:
            if line.part == part:
                rows.append(f"  {line.state:<8}{line.name:<{width + 2}}{line.found}")
                rows += [f"  {'':<{width + 10}}-> {line.mend}"] if line.mend else []
    return rows[1:]


def as_json(facts: Facts, report: Report, device: str, why: str) -> dict[str, Any]:
    """Everything as JSON values; keys stay, new ones may come.

    Args:
        device, why: what `--device auto` would use, and the reason.
    """
    return {
        "version": 1,
        "device": device,
        "why": why,
        "cuda_works": report.works,
        "only_to_compile": report.only_to_compile,
        "blocking": report.blocking.name if report.blocking else None,
        "next_step": report.next_step,
        "lines": [asdict(line) for line in report.lines],
        "facts": asdict(facts),
    }
