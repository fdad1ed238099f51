"""Threads over frames: results in order, few items in memory, errors in their place, and torch as it was before."""

from __future__ import annotations

import threading
import time as clock
from collections.abc import Iterator

import numpy as np
import pytest
import torch

from endoprior.system import parallel
from endoprior.system.parallel import AHEAD, frame_threads


@pytest.fixture
def four_threads(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(parallel, "workers", lambda _bytes_each: 4)


@pytest.mark.usefixtures("four_threads")
def test_results_come_in_the_order_of_the_items() -> None:
    def slower_at_first(item: int) -> int:
        clock.sleep(0.02 / (item + 1))
        return item * item

    with frame_threads(1) as pool:
        assert list(pool.map(slower_at_first, range(30))) == [item * item for item in range(30)]


@pytest.mark.usefixtures("four_threads")
def test_several_items_are_computed_at_the_same_time() -> None:
    together = threading.Barrier(4, timeout=20)  # opens when four calls wait at it
    with frame_threads(1) as pool:
        assert sorted(pool.map(lambda _: together.wait(), range(4))) == [0, 1, 2, 3]


@pytest.mark.usefixtures("four_threads")
def test_few_items_are_taken_ahead_of_the_results() -> None:
    taken = []

    def items() -> Iterator[int]:
        for item in range(100):
            taken.append(item)
            yield item

    with frame_threads(1) as pool:
        results = pool.map(str, items())
        for used in range(20):
            next(results)
            assert len(taken) <= used + 4 * AHEAD


@pytest.mark.usefixtures("four_threads")
def test_an_error_is_raised_where_its_result_would_be() -> None:
    def inverse(item: int) -> float:
        return 1 / (item - 5)

    seen = []
    with frame_threads(1) as pool, pytest.raises(ZeroDivisionError):
        seen.extend(pool.map(inverse, range(50)))
    assert seen == [inverse(item) for item in range(5)]


@pytest.mark.usefixtures("four_threads")
def test_stages_share_the_threads_and_do_not_wait_for_each_other() -> None:
    with frame_threads(1) as pool:
        first = pool.map(lambda item: item + 1, range(40))
        assert list(pool.map(lambda item: 2 * item, first)) == [2 * (item + 1) for item in range(40)]


@pytest.mark.usefixtures("four_threads")
def test_torch_uses_one_thread_inside_and_as_many_as_before_after() -> None:
    before = torch.get_num_threads()
    torch.set_num_threads(3)
    try:
        with frame_threads(1) as pool:
            assert set(pool.map(lambda _: torch.get_num_threads(), range(8))) == {1}
        assert torch.get_num_threads() == 3
        later = list[int]()
        thread = threading.Thread(target=lambda: later.append(torch.get_num_threads()))
        thread.start()
        thread.join()
        assert later == [3]
    finally:
        torch.set_num_threads(before)


def test_tools_of_a_frame_do_not_depend_on_the_number_of_threads(monkeypatch: pytest.MonkeyPatch) -> None:
    from endoprior.tool_masks import ToolFinder

    finder, view = ToolFinder(), np.ones((96, 128), bool)
    images = [np.random.default_rng(i).integers(0, 255, (96, 128, 3), np.uint8) for i in range(6)]
    found = []
    for num in (1, 3):
        monkeypatch.setattr(parallel, "workers", lambda _bytes_each, num=num: num)
        with frame_threads(1) as pool:
            found.append(list(pool.map(lambda image: finder.log_odds(image, view), images)))
    assert all(np.array_equal(one, three) for one, three in zip(*found, strict=True))
