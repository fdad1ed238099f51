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


def main(work: Path) -> list[Row]:
    """Stop each command that writes files, by each signal."""
    data, trained = small_sequence(work / "data"), work / "run"
    demand(run(*arguments(data, trained, 60)))
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
