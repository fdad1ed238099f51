"""SIGTERM and SIGHUP while a command writes: exit status 130, one line, nothing partial stays."""

from __future__ import annotations

import signal
import time
from pathlib import Path

from harness import Program, Row, demand, leftovers, run, small_sequence
from kills import arguments

SIGNALS = (signal.SIGTERM, signal.SIGHUP)


def stopped(words: list[object], out: Path, number: signal.Signals) -> Row:
    """Send a signal once there is something of the output; what is hidden until it is complete counts."""
    name = f"{words[0]} {words[-1] if words[0] == 'export' else ''}".strip()
    program = Program(*words)
    while program.running and not any(out.parent.glob(f"*{out.stem}*")):
        time.sleep(0.002)
    program.process.send_signal(number)
    done = program.wait()
    left = leftovers(out.parent) + [out.name] * out.exists()
    told = f"exit {done.status}, {len(done.err.splitlines())} line, left: {', '.join(left) or 'nothing'}"
    passed = done.status == 130 and done.err == "endoprior: interrupted\n" and not left
    return Row("stops", f"{number.name}: {name}", told, passed)


def main(work: Path) -> list[Row]:
    """Stop each command that writes files, by each signal."""
    data, trained = small_sequence(work / "data"), work / "run"
    demand(run(*arguments(data, trained, 60)))
    rows = []
    for number in SIGNALS:
        out = work / number.name / "out"
        out.parent.mkdir()
        film = out.with_suffix(".mp4")
        rows += [
            stopped(["phantom", out, "--frames", 60, "--width", 320, "--height", 256], out, number),
            stopped(["prepare", data / "images", out, "--layout", "mono"], out, number),
            stopped(["prior", data, out], out, number),
            stopped(["render", trained, out, "--split", "video"], out, number),
            stopped(["export", trained, film, "--format", "video"], film, number),
        ]
    return rows
