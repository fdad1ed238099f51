"""A bounded job queue: many threads add jobs, one thread runs them."""

from __future__ import annotations

import threading
from collections import deque
from collections.abc import Callable, Hashable

Job = Callable[[], None]
MAX_WAITING = 200
"""Largest number of waiting jobs; a person never reaches it."""


class JobQueue:
    """A bounded queue of jobs."""

    def __init__(self) -> None:
        self._waiting: deque[tuple[Hashable, Job]] = deque()
        self._keys: set[Hashable] = set()
        self._changed = threading.Condition()

    def put(self, job: Job, key: Hashable = None, *, surely: bool = False) -> None:
        """Add a job. Jobs beyond `MAX_WAITING` are dropped.

        Args:
            key: only one job per key waits at a time. The job reads its state when it runs, so it uses the newest.
            surely: never drop this job.
        """
        with self._changed:
            if key is not None and key in self._keys:
                return
            if key is None and not surely and len(self._waiting) >= MAX_WAITING:
                return
            self._keys |= set() if key is None else {key}
            self._waiting.append((key, job))
            self._changed.notify()

    def take(self, seconds: float) -> list[Job]:
        """All waiting jobs, in order; an empty list if none arrives within `seconds`."""
        with self._changed:
            if not self._waiting and seconds > 0:
                self._changed.wait(min(seconds, threading.TIMEOUT_MAX))
            jobs = [job for _, job in self._waiting]
            self._waiting.clear()
            self._keys.clear()
            return jobs
