"""Kill training with SIGKILL at random moments, go on, and compare every byte with a run that nobody touched.

A third of the kills strike while a checkpoint is being written, a third in the loop, a third anywhere from the first
moment on: start, loading, first checkpoint, scoring.
"""

from __future__ import annotations

import random
import time
from collections import Counter
from pathlib import Path

from harness import Program, Row, demand, differences, leftovers, run, small_sequence

PARTIAL_CHECKPOINT = ".checkpoint.*.partial*"
QUICK_CHECKPOINTS = ("--checkpoint-seconds", "0.2")


def arguments(data: Path, out: Path, iterations: int) -> list[object]:
    """A short training, everything of the method in it."""
    schedule = ("--schedule.coarse-iterations", 60, "--schedule.fine-iterations", iterations)
    growth = ("--init-budget", 2000, "--density.start-iteration", 50, "--density.every", 50)
    return ["train", data, out, "--no-networks", *schedule, *growth]


def kill_once(program: Program, out: Path, when: str, rng: random.Random) -> str:
    """Kill a training at a random moment of some kind.

    Args:
        when: `writing`, while a checkpoint is written; `loop`, within a second of its first iterations; `anywhere`.
    Returns:
        What it was doing: `writing`, `loop`, `start`, or `done` if it ended first.
    """
    log, size = out / "log.jsonl", (out / "log.jsonl").stat().st_size if (out / "log.jsonl").exists() else 0
    until = time.monotonic() + (rng.uniform(0, 6) if when == "anywhere" else 600)
    in_loop_until = None
    while program.running and time.monotonic() < until:
        partial = list(out.glob(PARTIAL_CHECKPOINT))
        if when == "writing" and partial:
            time.sleep(rng.uniform(0, 0.02))
            break
        if in_loop_until is None and log.exists() and log.stat().st_size > size:
            in_loop_until = time.monotonic() + rng.uniform(0, 1.0)
        if when == "loop" and in_loop_until and time.monotonic() > in_loop_until:
            break
        time.sleep(0.001)
    if not program.running:
        return "done"
    program.kill()
    writing = bool(list(out.glob(PARTIAL_CHECKPOINT)))
    return "writing" if writing else "loop" if in_loop_until else "start"


def main(work: Path, kills: int = 50, iterations: int = 3500, seed: int = 0) -> list[Row]:
    """Run the test in the folder `work`."""
    rng, seen = random.Random(seed), Counter()
    data, whole, parts = small_sequence(work / "data"), work / "whole", work / "parts"
    demand(run(*arguments(data, whole, iterations)))
    refused = []
    for i in range(kills):
        # Without --resume until there is something to go on with: what a script would do that a scheduler restarts.
        resume = ["--resume"] if (parts / "config.json").exists() else []
        program = Program(*arguments(data, parts, iterations), *QUICK_CHECKPOINTS, *resume)
        seen[kill_once(program, parts, ("writing", "loop", "anywhere")[i % 3], rng)] += 1
        done = program.wait()
        if done.status not in (0, -9):
            refused.append(done.in_words)
    demand(run(*arguments(data, parts, iterations), "--resume"))
    different = differences(parts, whole) + leftovers(parts)
    told = ", ".join(f"{count} {name}" for name, count in sorted(seen.items()))
    # Kernels are compiled for the first run and loaded by all others.
    demand(run(*arguments(data, work / "later", 300)))
    demand(run(*arguments(data, work / "first", 300), NUMBA_CACHE_DIR=str(work / "kernels")))
    first = differences(work / "first", work / "later")
    return [
        Row("kills", f"{kills} SIGKILLs ({told}): runs that could not go on", str(len(refused)), not refused),
        Row("kills", "files that differ from an uninterrupted run", ", ".join(different) or "none", not different),
        Row("kills", "... of the first run after installation from a later one", ", ".join(first) or "none", not first),
    ]
