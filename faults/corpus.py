"""Feeds broken and hostile inputs to the command line, each to a process of its own, and checks how it ends.

A refusal is exit status 2 and one line on stderr that names the file or the option; nothing is written, nothing is
changed. `python faults/corpus.py [--out REPORT.json] [--only WORD]`; exit status 1 if a case ended otherwise.
"""

from __future__ import annotations

import argparse
import json
import os
import resource
import subprocess
import sys
import tempfile
import time as clock
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path

import corpus_numbers
import corpus_options
import corpus_prepare
import corpus_runs
import corpus_sequences
import corpus_videos
from corpus_case import Case, Samples, complaints, snapshot

PARTS = (corpus_sequences, corpus_numbers, corpus_videos, corpus_prepare, corpus_options, corpus_runs)
CASES: list[Case] = [case for part in PARTS for case in part.CASES]
SECONDS = 60
"""A case that takes longer hangs."""
MEMORY_BYTES, FILE_BYTES = 6 << 30, 1 << 30
"""Limits of address space, and of each file written."""


def run_case(case: Case, folder: Path, samples: Samples) -> tuple[list[str], float, str]:
    """Build a case below `folder`, which must be new, and run it in a process.

    Returns:
        What is wrong with how it ended, seconds, and what it wrote to stderr.
    """
    work = folder / "work"
    work.mkdir(parents=True)
    argv = case.build(work, samples)
    before = snapshot(folder)
    began = clock.perf_counter()
    try:
        done = subprocess.run(
            [sys.executable, "-m", "endoprior", *argv],
            cwd=work,
            stdin=subprocess.DEVNULL,
            capture_output=True,
            timeout=SECONDS,
            preexec_fn=_limit,
        )
    except subprocess.TimeoutExpired:
        return [f"no end after {SECONDS} s"], float(SECONDS), ""
    seconds = clock.perf_counter() - began
    errors = done.stderr.decode(errors="replace")
    wrong = complaints(case, done.returncode, errors, before, snapshot(folder))
    return wrong + ([] if wrong or case.check(work) else ["a wrong result"]), seconds, errors


def _limit() -> None:
    resource.setrlimit(resource.RLIMIT_AS, (MEMORY_BYTES, MEMORY_BYTES))
    resource.setrlimit(resource.RLIMIT_FSIZE, (FILE_BYTES, FILE_BYTES))


def main(argv: list[str]) -> int:
    """Run the corpus; 1 if a case ended otherwise than it must."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--out", type=Path, help="write what was found as JSON")
    parser.add_argument("--only", default="", help="cases with this word in their names")
    parser.add_argument("--workers", type=int, default=2)
    args = parser.parse_args(argv)
    chosen = [c for c in CASES if args.only in c.name and not (c.needs_user and os.geteuid() == 0)]
    os.environ["OMP_WAIT_POLICY"] = "PASSIVE"
    with tempfile.TemporaryDirectory(prefix="corpus-") as place, ThreadPoolExecutor(args.workers) as pool:
        samples = Samples(Path(place, "samples"))
        samples.folder.mkdir()
        _ = samples.sequence, samples.video, samples.run
        folders = [Path(place, f"case{i}") for i in range(len(chosen))]
        rows = []
        for case, (wrong, seconds, errors) in zip(
            chosen, pool.map(lambda pair: run_case(*pair, samples), zip(chosen, folders, strict=True)), strict=True
        ):
            rows.append({"name": case.name, "wrong": wrong, "seconds": round(seconds, 2), "stderr": errors[-2000:]})
            if wrong:
                print(f"{case.name}: {'; '.join(wrong)}\n    {errors.strip()[-300:]}", flush=True)
    good = [row for row in rows if not row["wrong"]]
    refused = sum(bool(case.says) for case, row in zip(chosen, rows, strict=True) if not row["wrong"])
    slowest = max((row["seconds"] for row in rows), default=0)
    print(
        f"{len(good)} of {len(rows)} cases: {refused} refused with one line, {len(good) - refused} work; "
        f"slowest {slowest:.1f} s; {len(CASES) - len(chosen)} left out"
    )
    if args.out:
        args.out.write_text(json.dumps(rows, indent=1) + "\n", encoding="utf-8")
    return 1 if len(good) < len(rows) else 0


if __name__ == "__main__":
    sys.exit(main(sys.argv[1:]))
