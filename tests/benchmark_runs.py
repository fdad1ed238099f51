"""Cells of a benchmark run in this process, and what a run leaves unchanged."""

from __future__ import annotations

import hashlib
from collections.abc import Iterator
from pathlib import Path

from endoprior_studies.execute import Outcome
from endoprior_studies.worker import CellJob, work


def in_this_process(jobs: list[CellJob]) -> Iterator[Outcome]:
    """An executor: one job after the other."""
    for job in jobs:
        work(job)
        yield Outcome(job, 1.0)


def contents(folder: Path) -> dict[str, tuple[int, str]]:
    """Time of change and hash of every file."""
    files = [file for file in sorted(folder.rglob("*")) if file.is_file()]
    return {str(f): (f.stat().st_mtime_ns, hashlib.sha256(f.read_bytes()).hexdigest()) for f in files}
