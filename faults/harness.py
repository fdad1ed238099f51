"""What every fault test shares: commands as real processes under limits, bytes compared, rows of results."""

from __future__ import annotations

import hashlib
import json
import os
import re
import resource
import subprocess
import sys
import tempfile
import time
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path

ENVIRONMENT = os.environ | {"OMP_WAIT_POLICY": "PASSIVE", "PYTHONUNBUFFERED": "1"}
TIMEOUT_S = 600


@dataclass(frozen=True)
class Row:
    part: str
    what: str
    figure: str
    passed: bool


@dataclass(frozen=True)
class Done:
    """A process that has ended."""

    status: int
    """Exit status; minus the signal's number if one ended it."""
    out: str
    err: str
    seconds: float
    peak_mb: float
    """Most memory it had resident, MB."""

    @property
    def one_line(self) -> bool:
        """Whether it refused as promised: status 2 and one line on stderr."""
        return self.status == 2 and self.err.startswith("endoprior: ") and self.err.count("\n") == 1

    @property
    def in_words(self) -> str:
        """What it said, for a row: the reason of a refusal, else status and the end of the complaint."""
        if self.one_line and (reason := re.search(r"[;,] got (.*?)\. ", self.err)):
            return f"refused: {reason[1]}"
        return f"exit {self.status}: {' '.join(self.err.split())[-160:] or 'nothing on stderr'}"


def command(*words: object) -> list[str]:
    return [sys.executable, "-P", "-m", "endoprior", *map(str, words)]


class Program:
    """The program as a process of its own, with its own limits."""

    def __init__(self, *words: object, limits: Mapping[int, int] | None = None, **variables: str) -> None:
        """Start it.

        Args:
            words: the command line after `endoprior`.
            limits: {resource.RLIMIT_...: value}.
            variables: of the environment.
        """

        def limit() -> None:
            for kind, value in (limits or {}).items():
                resource.setrlimit(kind, (value, value))

        # Files, not pipes: those fill up while nobody reads them.
        self._outputs = [tempfile.TemporaryFile("w+", encoding="utf-8") for _ in range(2)]
        self._began = time.monotonic()
        out, err = self._outputs
        environment = ENVIRONMENT | variables
        self.process = subprocess.Popen(command(*words), env=environment, stdout=out, stderr=err, preexec_fn=limit)

    @property
    def running(self) -> bool:
        return os.waitid(os.P_PID, self.process.pid, os.WEXITED | os.WNOHANG | os.WNOWAIT) is None

    def kill(self) -> None:
        self.process.kill()

    def wait(self, timeout: float = TIMEOUT_S) -> Done:
        """Wait for its end; after `timeout` s it is killed, and has status -9."""
        while self.running:
            if time.monotonic() > self._began + timeout:
                self.kill()
            time.sleep(0.005)
        _, state, usage = os.wait4(self.process.pid, 0)
        self.process.returncode = os.waitstatus_to_exitcode(state)
        said = []
        for file in self._outputs:
            file.seek(0)
            said.append(file.read())
            file.close()
        return Done(self.process.returncode, *said, time.monotonic() - self._began, usage.ru_maxrss / 1024)


def run(*words: object, timeout: float = TIMEOUT_S, limits: Mapping[int, int] | None = None, **variables: str) -> Done:
    return Program(*words, limits=limits, **variables).wait(timeout)


def demand(done: Done) -> Done:
    """A run that had to succeed.

    Raises:
        RuntimeError: it did not; with what it said.
    """
    if done.status:
        raise RuntimeError(f"a step that must work did not: {done.in_words}")
    return done


def small_sequence(folder: Path, frames: int = 24, width: int = 160, height: int = 128) -> Path:
    demand(run("phantom", folder, "--frames", frames, "--width", width, "--height", height))
    return folder


def training(data: Path, out: Path, iterations: int) -> list[object]:
    schedule = ("--schedule.coarse-iterations", 60, "--schedule.fine-iterations", iterations)
    growth = ("--init-budget", 2000, "--density.start-iteration", 50, "--density.every", 50)
    return ["train", data, out, "--no-networks", *schedule, *growth]


def digest(file: Path) -> str:
    return hashlib.sha256(file.read_bytes() if file.is_file() else b"").hexdigest()


def log_without_clock(run_folder: Path) -> list[dict]:
    """The lines of `log.jsonl` without the times they took."""
    lines = [json.loads(line) for line in (run_folder / "log.jsonl").read_text(encoding="utf-8").splitlines()]
    return [{name: value for name, value in line.items() if name != "seconds"} for line in lines]


def differences(run_folder: Path, reference: Path) -> list[str]:
    """Files of a finished run that differ from those of another run of the same."""
    found = [
        name
        for name in ("scene.safetensors", "checkpoint.safetensors")
        if digest(run_folder / name) != digest(reference / name)
    ]
    if log_without_clock(run_folder) != log_without_clock(reference):
        found.append("log.jsonl")
    return found


def leftovers(folder: Path) -> list[str]:
    """Names of half-written files below a folder: what is hidden, but for locks and what `prepare` resumes."""
    hidden = (file.relative_to(folder) for file in folder.rglob(".*"))
    return sorted(str(path) for path in hidden if not path.name.endswith(".lock") and ".preparing" not in str(path))
