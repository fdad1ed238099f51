"""Run jobs in parallel: on the cores of this machine, or on a Ray cluster. A failing job does not stop the others."""

from __future__ import annotations

import os
import signal
import subprocess
import time as clock
from collections.abc import Callable, Iterator
from concurrent.futures import FIRST_COMPLETED, ThreadPoolExecutor, wait
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path

from endoprior.system.console import say
from endoprior.system.ray_cluster import connected
from endoprior.system.surroundings import python_command

from .worker import CellJob

SHOWN_LOG_LINES = 3


@dataclass(frozen=True)
class Outcome:
    """How a job ended."""

    job: CellJob
    seconds: float
    failure: str = ""
    """Why it failed, from the end of its log; empty if it succeeded."""


Executor = Callable[[list[CellJob]], Iterator[Outcome]]
"""Where jobs run; yields the outcome of each as it ends."""


def run_job(job: CellJob, started: list[subprocess.Popen] | None = None) -> Outcome:
    """Run one job in its own process and wait for it; its output goes to `.log.txt` beside its cell's folder.

    Args:
        started: the process is appended to it, so that others can signal it.
    """
    folder = Path(job.folder)
    folder.parent.mkdir(parents=True, exist_ok=True)
    job_file, log = folder.with_suffix(".job.json"), folder.with_suffix(".log.txt")
    job.write(job_file)
    threads = {"OMP_NUM_THREADS": str(job.threads), "NUMBA_NUM_THREADS": str(job.threads)}
    environment = os.environ | threads | {"PYTHONUTF8": "1"}  # the log is read as UTF-8
    environment.setdefault("OMP_WAIT_POLICY", "PASSIVE")
    began = clock.perf_counter()
    with open(log, "wb") as output:
        command = python_command("endoprior_studies.worker", str(job_file))
        process = subprocess.Popen(command, stdout=output, stderr=subprocess.STDOUT, env=environment)
        if started is not None:
            started.append(process)
        code = process.wait()
    seconds = clock.perf_counter() - began
    if code == 0:
        job_file.unlink()
        return Outcome(job, seconds)
    lines = [line for line in log.read_text(encoding="utf-8", errors="replace").splitlines() if line.strip()]
    end = " | ".join(lines[-SHOWN_LOG_LINES:]) or "(empty)"
    return Outcome(job, seconds, f"exit status {code}; end of {log}: {end}")


@contextmanager
def local_executor(num_jobs: int) -> Iterator[Executor]:
    """Processes of this machine, `num_jobs` at a time. Ctrl-C interrupts all of them, and each saves its state."""
    started: list[subprocess.Popen] = []

    def execute(jobs: list[CellJob]) -> Iterator[Outcome]:
        waiting = list(reversed(jobs))
        with ThreadPoolExecutor(num_jobs) as pool:
            running = set()
            try:
                while waiting or running:
                    while waiting and len(running) < num_jobs:
                        running.add(pool.submit(run_job, waiting.pop(), started))
                    done, running = wait(running, return_when=FIRST_COMPLETED)
                    yield from (future.result() for future in done)
            except BaseException:
                for process in started:
                    # Windows cannot send it, but its console sends Ctrl-C to all processes.
                    if process.poll() is None and os.name == "posix":
                        process.send_signal(signal.SIGINT)
                raise

    yield execute


@contextmanager
def ray_executor(address: str, threads: int) -> Iterator[Executor]:
    """A Ray cluster that shares this machine's file system; `local` starts one here.

    Raises:
        InputError: as `connected`, and if no machine has so many cores.
    """
    with connected(address, say) as cluster:

        def execute(jobs: list[CellJob]) -> Iterator[Outcome]:
            for job in jobs:
                cluster.start(job, run_job, job, cores=threads)
            while cluster.num_running:
                ended = cluster.next()
                yield ended.value or Outcome(ended.key, 0.0, f"{ended.error}")

        yield execute
