"""Signals: a killed training goes on and equals a run that nobody touched; other commands end cleanly.

A third of the kills strike while a checkpoint is being written, a third in the loop, a third anywhere from the first
moment on: start, loading, first checkpoint, scoring. SIGTERM and SIGHUP, while a command writes, give exit status 130
and one line; nothing partial stays.
"""

from __future__ import annotations

import random
import signal
import time
from collections import Counter
from pathlib import Path

from harness import Program, Row, demand, differences, leftovers, run, small_sequence, training

PARTIAL_CHECKPOINT = ".checkpoint.*.partial*"
SIGNALS = (signal.SIGTERM, signal.SIGHUP)
QUICK_CHECKPOINTS = ("--checkpoint-seconds", "0.2")


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


def kills(work: Path, times: int = 50, iterations: int = 3500, seed: int = 0) -> list[Row]:
    """Run the test in the folder `work`."""
    rng, seen = random.Random(seed), Counter()
    data, whole, parts = small_sequence(work / "data"), work / "whole", work / "parts"
    demand(run(*training(data, whole, iterations)))
    refused = []
    for i in range(times):
        # Without --resume until there is something to go on with: what a script would do that a scheduler restarts.
        resume = ["--resume"] if (parts / "config.json").exists() else []
        program = Program(*training(data, parts, iterations), *QUICK_CHECKPOINTS, *resume)
        seen[kill_once(program, parts, ("writing", "loop", "anywhere")[i % 3], rng)] += 1
        done = program.wait()
        if done.status not in (0, -9):
            refused.append(done.in_words)
    demand(run(*training(data, parts, iterations), "--resume"))
    different = differences(parts, whole) + leftovers(parts)
    told = ", ".join(f"{count} {name}" for name, count in sorted(seen.items()))
    # Kernels are compiled for the first run and loaded by all others.
    demand(run(*training(data, work / "later", 300)))
    demand(run(*training(data, work / "first", 300), NUMBA_CACHE_DIR=str(work / "kernels")))
    first = differences(work / "first", work / "later")
    return [
        Row("kills", f"{times} SIGKILLs ({told}): runs that could not go on", str(len(refused)), not refused),
        Row("kills", "files that differ from an uninterrupted run", ", ".join(different) or "none", not different),
        Row("kills", "... of the first run after installation from a later one", ", ".join(first) or "none", not first),
    ]


def stopped(words: list[object], out: Path, number: signal.Signals) -> Row:
    """Send a signal once there is something of the output; what is hidden until it is complete counts."""
    name = f"{words[0]} {words[-1] if words[0] == 'export' else ''}".strip()
    out.parent.mkdir(parents=True)
    program = Program(*words)
    while program.running and not any(out.parent.iterdir()):
        time.sleep(0.002)
    program.process.send_signal(number)
    done = program.wait()
    left = leftovers(out.parent) + [out.name] * out.exists()
    told = f"exit {done.status}, {len(done.err.splitlines())} line, left: {', '.join(left) or 'nothing'}"
    passed = done.status == 130 and done.err == "endoprior: interrupted\n" and not left
    return Row("stops", f"{number.name}: {name}", told, passed)


def stops(work: Path) -> list[Row]:
    """Stop each command that writes files, by each signal."""
    data, trained = small_sequence(work / "data"), work / "run"
    demand(run(*training(data, trained, 60)))
    rows = []
    for number in SIGNALS:
        commands = {
            "phantom": ["phantom", "OUT", "--frames", 60, "--width", 320, "--height", 256],
            "prepare": ["prepare", data / "images", "OUT", "--layout", "mono"],
            "prior": ["prior", data, "OUT"],
            "render": ["render", trained, "OUT", "--split", "video"],
            "film.mp4": ["export", trained, "OUT", "--format", "video"],
        }
        for name, words in commands.items():
            out = work / number.name / name / name
            rows.append(stopped([out if word == "OUT" else word for word in words], out, number))
    return rows
