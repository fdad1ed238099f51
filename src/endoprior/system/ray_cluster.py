"""Call functions in the processes of a Ray cluster, whose machines share one file system. A process may die."""

from __future__ import annotations

import importlib
import logging
import os
import re
import secrets
import socket
import sys
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from functools import partial
from typing import Any

from ..core.checks import input_error
from ..core.shell import install_command
from .signals import handled_by

CONNECT_SECONDS = 5.0
"""Longest time that a machine may take to answer."""
SIGNAL_SECONDS = 1.0
"""Longest time after which a signal whose exception was lost is noticed."""
SAVE_SECONDS = 120.0
"""Longest time that interrupted calls may take to save their state."""
SET_UP = "endoprior.system.surroundings.set_up_process"
"""What each process of the cluster calls first, as the command line does."""
HOST_AND_PORT = re.compile(r"(?:ray://)?\[?([^/\]]+)\]?:(\d+)")
"""An address that names a machine, unlike `auto` and `local`."""


@dataclass(frozen=True)
class Ended:
    """How a call ended: what the function returned or raised, or why its process died, too often."""

    key: Any
    """What `Cluster.start` was given."""
    value: Any = None
    error: Exception | None = None


class Cluster:
    """Calls that run on a cluster, as many at a time as it has cores for. See `connected`."""

    def __init__(self, ray: Any, say: Callable[[str], None]) -> None:
        self._ray, self._say = ray, say
        self._running = dict[Any, tuple[Any, Callable[[], Any], int]]()
        """Key, how to call it again, and how often, by Ray's reference."""
        self.interrupted = False
        """Whether a signal asked to stop."""

    @property
    def num_running(self) -> int:
        """Number of calls that have not ended."""
        return len(self._running)

    def cores_for(self, num_calls: int) -> int:
        """Cores for each of so many equal calls, so that all of them run at once if that is possible."""
        machines = self._cores()
        return max(1, min(sum(machines) // max(num_calls, 1), *machines))

    def start(
        self,
        key: Any,
        function: Callable[..., Any],
        *arguments: Any,
        cores: int = 1,
        on_gpu: bool = False,
        restarts: int = 0,
    ) -> None:
        """Call `function(*arguments)` as soon as a machine has that many free cores; `next` tells how it ended.

        Args:
            key: what `next` calls it.
            function: of a module of this program, which every machine has.
            on_gpu: it also needs a GPU of its own.
            restarts: how often it is called again if its process dies.
        """
        if cores > (most := max(self._cores())):
            raise input_error("--ray", f"a machine with {cores} cores", f"at most {most}", "ask for fewer cores.")
        if on_gpu and not self._ray.cluster_resources().get("GPU"):
            raise input_error("--ray", "a cluster with a GPU", "none", "add `--device cpu`.")
        options = {"num_cpus": cores, "max_retries": 0} | ({"num_gpus": 1} if on_gpu else {})
        submit = partial(self._ray.remote(**options)(function).remote, *arguments)
        self._running[submit()] = key, submit, restarts

    def next(self) -> Ended:
        """Wait for a call to end. One whose process dies is called again, as often as it may be."""
        errors = self._ray.exceptions
        while True:
            ended: list[Any] = []
            while not ended:
                if self.interrupted:
                    raise KeyboardInterrupt
                ended, _ = self._ray.wait(list(self._running), num_returns=1, timeout=SIGNAL_SECONDS)
            key, submit, restarts = self._running.pop(ended[0])
            try:
                return Ended(key, self._ray.get(ended[0]))
            except errors.RayTaskError as error:
                cause = getattr(error, "cause", None)
                if not isinstance(cause, Exception):
                    return Ended(key, error=error)
                cause.__cause__ = error  # which tells where it was raised
                return Ended(key, error=cause)
            except errors.RayError as error:
                lines = [line for line in str(error).splitlines() if line.strip()]
                reason = lines[0].partition(". ")[0].rstrip(".")[:160] if lines else type(error).__name__
                if not restarts:
                    return Ended(key, error=RuntimeError(f"Ray: {reason}"))
                self._say(f"{key}: its process died and is started again ({reason})")
                self._running[submit()] = key, submit, restarts - 1

    def interrupt(self) -> None:
        """Interrupt every call, like Ctrl-C, and wait until all have saved their state and ended."""
        if self._running:
            for reference in self._running:
                self._ray.cancel(reference)
            self._ray.wait(list(self._running), num_returns=len(self._running), timeout=SAVE_SECONDS)

    def _cores(self) -> list[int]:
        """Cores of each machine that has any."""
        found = (int(node["Resources"].get("CPU", 0)) for node in self._ray.nodes() if node["Alive"])
        return [cores for cores in found if cores] or [1]


@contextmanager
def connected(address: str, say: Callable[[str], None]) -> Iterator[Cluster]:
    """Connect to a Ray cluster; `local` starts one on this machine, `auto` finds one that runs here.

    If the body raises, all calls are interrupted. SIGTERM and SIGHUP count as Ctrl-C.
    """
    if address == "local" and "ray" not in sys.modules and "RAY_AUTH_MODE" not in os.environ:
        # It listens on all addresses of this machine, and runs what it is sent by whoever has the token.
        os.environ |= {"RAY_AUTH_MODE": "token", "RAY_AUTH_TOKEN": secrets.token_hex(32)}
    try:
        ray: Any = importlib.import_module("ray")
    except ImportError:
        raise input_error("--ray", "Ray", "none", f"`{install_command('ray')}`.") from None
    fix = "start it, correct --ray, or use `--ray local`; if it asks for a token, set RAY_AUTH_MODE=token."
    os.environ.setdefault("RAY_USAGE_STATS_ENABLED", "0")  # nothing is sent to others
    wait_policy = {"OMP_WAIT_POLICY": os.environ.get("OMP_WAIT_POLICY", "PASSIVE")}
    # Ray puts the current folder first where its processes look for modules, except for jobs of its own client.
    job = ray.job_config.JobConfig()
    job._client_job = True
    try:
        if named := HOST_AND_PORT.fullmatch(address):  # Ray would wait for minutes, then end the process
            socket.create_connection((named[1], int(named[2])), CONNECT_SECONDS).close()
        ray.init(
            address=address,
            log_to_driver=False,
            include_dashboard=False,
            logging_level=logging.ERROR,
            job_config=job,
            runtime_env={"env_vars": wait_policy, "worker_process_setup_hook": SET_UP},
        )
    except (ConnectionError, OSError, ValueError, RuntimeError, SystemExit) as error:
        is_silent = isinstance(error, SystemExit)  # raised by Ray, after minutes, where another program answers
        got = "none" if is_silent else " ".join(str(error).split()).rstrip(".") or type(error).__name__
        raise input_error(f"--ray {address}", "a running cluster", got[:200], fix) from error
    cluster = Cluster(ray, say)

    def interrupt(_signum: int, _frame: Any) -> None:
        cluster.interrupted = True  # what is raised here can be lost inside of Ray
        raise KeyboardInterrupt

    try:
        with handled_by(interrupt):  # Ray ends the process on the first signal of a scheduler or closing terminal
            try:
                yield cluster
            except BaseException:
                cluster.interrupt()
                raise
    finally:
        ray.shutdown()
