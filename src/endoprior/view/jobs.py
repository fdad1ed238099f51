"""What many threads ask for and one thread does: a queue that neither a flood nor a hurry can fill."""

from __future__ import annotations

import threading
from collections import deque
from collections.abc import Callable, Hashable

Job = Callable[[], None]
MOST_WAITING = 200
"""Presses of buttons and clicks that wait at once; a person gets nowhere near it."""


class Jobs:
    """A queue of jobs."""

    def __init__(self) -> None:
        self._waiting: deque[tuple[Hashable, Job]] = deque()
        self._keys: set[Hashable] = set()
        self._changed = threading.Condition()

    def put(self, job: Job, key: Hashable = None, *, surely: bool = False) -> None:
        """Ask for a job; too many are dropped.

        Args:
            key: of jobs with the same key one waits at a time: whoever reads a state when it runs, reads the last one.
            surely: never drop it.
        """
        with self._changed:
            if key is not None and key in self._keys:
                return
            if key is None and not surely and len(self._waiting) >= MOST_WAITING:
                return
            self._keys |= set() if key is None else {key}
            self._waiting.append((key, job))
            self._changed.notify()

    def take(self, seconds: float) -> list[Job]:
        """All that wait at this moment, in order; none, if nothing comes within `seconds`."""
        with self._changed:
            if not self._waiting and seconds > 0:
                self._changed.wait(min(seconds, threading.TIMEOUT_MAX))
            jobs = [job for _, job in self._waiting]
            self._waiting.clear()
            self._keys.clear()
            return jobs
