"""Every fault test, one after the other: `python faults/run.py [--only PART ...] [--write docs/reliability.md]`.

Prints a table as it goes; with --write it also replaces the one in that file. Exit status 1 if anything failed.
"""

from __future__ import annotations

import argparse
import os
import platform
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable
from pathlib import Path

import drives
import kills
import limits
import shortage
from corpus import CASES
from harness import ENVIRONMENT, Row

ROOT = Path(__file__).parents[1]
BEGIN, END = "<!-- figures: make test-faults -->", "<!-- end of figures -->"


def _tests(files: list[Path], *options: str, **variables: str) -> tuple[str, bool]:
    """Run tests; returns `n passed` and whether all did."""
    words = [sys.executable, "-m", "pytest", "-p", "no:cacheprovider", *options, *map(str, files)]
    environment = ENVIRONMENT | variables
    done = subprocess.run(words, cwd=ROOT, env=environment, capture_output=True, encoding="utf-8", check=False)
    if done.returncode:
        print(done.stdout[-6000:], done.stderr[-3000:], sep="\n", file=sys.stderr)
    last = (done.stdout.strip() or "no output").splitlines()[-1]  # `n passed in ...`
    return last.split(" in ")[0], done.returncode == 0


def properties(work: Path) -> list[Row]:
    """The property-based tests with random seeds and ten times as many examples as in the test suite."""
    files = sorted((ROOT / "tests").glob("test_properties_*.py"))
    return [Row("properties", "property-based tests, thorough", *_tests(files, ENDOPRIOR_HYPOTHESIS="thorough"))]


def inputs(work: Path) -> list[Row]:
    """Every bad and hostile input of the corpora."""
    told, passed = _tests([ROOT / "tests" / "test_bad_inputs.py"], "-m", "slow or not slow")
    figure = "none" if passed else told
    return [Row("inputs", f"{len(CASES)} bad and hostile inputs: tracebacks or wrong ends", figure, passed)]


PARTS: dict[str, Callable[[Path], list[Row]]] = {
    "kills": kills.kills,
    "disk": shortage.disk,
    "stops": kills.stops,
    "drives": drives.main,
    "memory": shortage.memory,
    "inputs": inputs,
    "properties": properties,
    "soak": limits.soak,
    "limits": limits.limits,
}


def table(rows: list[Row], minutes: float) -> str:
    """The rows as Markdown, with what they were measured on."""
    commit = subprocess.run(
        ["git", "describe", "--always", "--dirty=+"], cwd=ROOT, capture_output=True, encoding="utf-8", check=False
    ).stdout.strip()
    lines = ["| part | what | found | |", "|---|---|---|---|"]
    lines += [f"| {row.part} | {row.what} | {row.figure} | {'ok' if row.passed else '**failed**'} |" for row in rows]
    about = f"Commit {commit}, Python {platform.python_version()}, {os.cpu_count()} cores, {minutes:.0f} minutes."
    return "\n".join([*lines, "", about])


def main() -> int:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--only", nargs="*", choices=list(PARTS), default=list(PARTS))
    parser.add_argument("--write", type=Path, help="file whose table is replaced")
    chosen = parser.parse_args()
    began, rows = time.monotonic(), []
    for name in chosen.only:
        with tempfile.TemporaryDirectory(prefix="faults-") as work:
            part_began = time.monotonic()
            try:
                found = PARTS[name](Path(work))
            except Exception as error:  # the other parts still run
                found = [Row(name, "the test itself", f"{type(error).__name__}: {error}", False)]
            for row in found:
                print(f"{'ok    ' if row.passed else 'FAILED'} {row.part}: {row.what}: {row.figure}", flush=True)
            print(f"       {name}: {time.monotonic() - part_began:.0f} s", flush=True)
            rows += found
    text = table(rows, (time.monotonic() - began) / 60)
    if chosen.write:
        page = chosen.write.read_text(encoding="utf-8")
        before, after = page.split(BEGIN)[0], page.split(END)[1]
        chosen.write.write_text(f"{before}{BEGIN}\n{text}\n{END}{after}", encoding="utf-8")
    print(f"\n{text}")
    return 0 if all(row.passed for row in rows) else 1


if __name__ == "__main__":
    sys.exit(main())
