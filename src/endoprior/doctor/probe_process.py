"""Run another program and get its output, or the reason why there is none: it may hang, crash or print without end."""

from __future__ import annotations

import os
import signal
import subprocess
import threading
import time as clock
from collections.abc import Sequence
from dataclasses import dataclass

MARK = "endoprior-probe "
"""Our probes print it before their answer, one line of JSON: libraries may print anything around that."""
MOST_BYTES = 2**20
"""A program that prints more than this is stopped."""
GRACE_S = 1.0
"""How long to wait for a killed program: if a driver hangs, its caller cannot end."""


@dataclass(frozen=True)
class Answer:
    """The output of a program."""

    text: str
    """What it printed, on both streams."""
    problem: str
    """Empty if it ended by itself with status 0, else why not, in a few words."""


def clean(text: str, most: int = 200) -> str:
    """One printable line of at most `most` characters."""
    words = " ".join("".join(c if c.isprintable() else " " for c in text).split())
    return words if len(words) <= most else words[: most - 3] + "..."


def run_program(command: Sequence[str], limit_s: float) -> Answer:
    """Run a program without input; never raises and never takes much longer than `limit_s`.

    Args:
        command: the program and its arguments.
        limit_s: it is killed after so many seconds, with all it started.
    """
    name = os.path.basename(command[0])
    began = clock.monotonic()
    try:
        process = subprocess.Popen(
            command,
            stdin=subprocess.DEVNULL,
            stdout=subprocess.PIPE,
            stderr=subprocess.STDOUT,
            start_new_session=os.name == "posix",
        )
    except (OSError, ValueError) as error:
        return Answer("", f"{name} cannot be run ({clean(getattr(error, 'strerror', None) or str(error))})")
    printed = bytearray()
    # Read in a thread: a program of the program may keep the pipe open after the program itself has ended.
    reader = threading.Thread(target=_read, args=(process, printed), daemon=True)
    reader.start()
    try:
        reader.join(limit_s)
        if len(printed) < MOST_BYTES:
            _wait(process, max(limit_s - (clock.monotonic() - began), 0.01))
        status = process.poll()
    finally:  # also after Ctrl-C
        _kill(process)
        reader.join(GRACE_S)
        if not reader.is_alive():
            process.stdout.close()
    text = bytes(printed[:MOST_BYTES]).decode("utf-8", "replace")
    if status is None:
        too_much = len(printed) >= MOST_BYTES
        return Answer(text, f"{name} printed without end" if too_much else f"{name} gave no answer in {limit_s:g} s")
    if status < 0:
        return Answer(text, f"{name} was ended by signal {-status}")
    return Answer(text, f"{name} ended with status {status}" if status else "")


def _read(process: subprocess.Popen, printed: bytearray) -> None:
    while len(printed) < MOST_BYTES:
        try:
            part = os.read(process.stdout.fileno(), 65536)
        except (OSError, ValueError):
            return
        if not part:
            return
        printed.extend(part)


def _wait(process: subprocess.Popen, seconds: float) -> None:
    try:
        process.wait(seconds)
    except subprocess.TimeoutExpired:
        pass


def _kill(process: subprocess.Popen) -> None:
    """End the program and everything it started."""
    try:
        if os.name == "posix":
            os.killpg(process.pid, signal.SIGKILL)
        elif process.poll() is None:
            process.kill()
    except OSError:  # all gone
        pass
    _wait(process, GRACE_S)
