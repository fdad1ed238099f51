"""Threads over frames. OpenCV, NumPy, the video decoder and torch release the interpreter lock while they compute.

What a thread computes must not depend on the others, so that results are the same for any number of threads.
"""

from __future__ import annotations

import sys
from collections import deque
from collections.abc import Callable, Iterable, Iterator
from concurrent.futures import Future, ThreadPoolExecutor
from contextlib import contextmanager
from typing import TypeVar

from .memory import workers

AHEAD = 2  # items for each thread that are computed, or wait, before their results are used
Item = TypeVar("Item")
Result = TypeVar("Result")


class Pool:
    """Threads that compute in order, with few items in memory."""

    def __init__(self, executor: ThreadPoolExecutor, num_threads: int) -> None:
        self._executor, self._most = executor, AHEAD * num_threads

    def map(self, function: Callable[[Item], Result], items: Iterable[Item]) -> Iterator[Result]:
        """Results in the order of the items. Items are taken while the results before are used, a few in advance.

        An error of `function` is raised in the place of its result.
        """
        waiting = deque[Future[Result]]()
        try:
            for item in items:
                waiting.append(self._executor.submit(function, item))
                if len(waiting) >= self._most:
                    yield waiting.popleft().result()
            while waiting:
                yield waiting.popleft().result()
        finally:
            for future in waiting:
                future.cancel()


@contextmanager
def frame_threads(bytes_each: int) -> Iterator[Pool]:
    """Threads, at most one for each core, whose calls of torch use one thread each; it must be imported before.

    Args:
        bytes_each: memory that one item needs.
    """
    torch, num = sys.modules.get("torch"), workers(bytes_each)
    before = torch.get_num_threads() if torch else 0
    try:
        with ThreadPoolExecutor(num, initializer=_one_torch_thread) as executor:
            yield Pool(executor, num)
    finally:
        if torch:
            torch.set_num_threads(before)  # threads that start later take over the last number that was set


def _one_torch_thread() -> None:
    if torch := sys.modules.get("torch"):
        torch.set_num_threads(1)
