"""Too little memory: whatever the limit, a run ends well or with one line, and can go on with more."""

from __future__ import annotations

import resource
from pathlib import Path

from harness import Row, demand, differences, leftovers, run, small_sequence
from kills import arguments

LIMITS_MB = (200, 500, 600, 700, 800, 900, 1000, 1300)
"""Of what the process may write to (`ulimit -d`), which counts stacks of threads and buffers that are never touched."""


def main(work: Path) -> list[Row]:
    """Train under each limit in turn, every time going on where the last one ended; then without a limit."""
    data, whole, parts = work / "data", work / "whole_memory", work / "parts_memory"
    if not data.exists():
        small_sequence(data)
    demand(run(*arguments(data, whole, 300)))
    rows = []
    for megabytes in LIMITS_MB:
        resume = ["--resume"] if (parts / "config.json").exists() else []
        done = run(*arguments(data, parts, 300), *resume, limits={resource.RLIMIT_DATA: megabytes * 2**20})
        passed = (done.status == 0 or done.one_line) and not leftovers(parts)
        rows.append(Row("memory", f"at most {megabytes} MB", "done" if done.status == 0 else done.in_words, passed))
    demand(run(*arguments(data, parts, 300), "--resume"))
    different = differences(parts, whole)
    rows.append(Row("memory", "... files that differ in the end", ", ".join(different) or "none", not different))
    return rows
