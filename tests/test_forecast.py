"""The time left of a whole command: known before, corrected as it proceeds, true for a training that gets slower."""

from __future__ import annotations

from dataclasses import replace

import pytest

from endoprior.model.presets import preset
from endoprior.pipeline.forecast import Forecast, Part, iterations, training_seconds


class Clock:
    """A clock that is set by hand."""

    seconds = 100.0

    def __call__(self) -> float:
        return self.seconds


def parts() -> list[Part]:
    return [
        Part("prepare", "looking", lambda done: 4.0 * done),
        Part("prepare", "writing", lambda done: 0.1 * done, 60),
        Part("train", "training", lambda done: 0.02 * done, 500),
        Part("player", "packing", lambda done: 2.0 * done),
    ]


def test_before_the_first_step_the_usual_times_are_said() -> None:
    assert Forecast(parts(), Clock()).left() == pytest.approx(4 + 6 + 10 + 2)


def test_it_counts_down_where_all_takes_its_usual_time() -> None:
    clock = Clock()
    forecast = Forecast(parts(), clock)
    for step, what, total, seconds in (
        ("prepare", "looking", 0, 4),
        ("prepare", "writing", 60, 6),
        ("train", "training", 500, 10),
    ):
        forecast.begin(step)
        began = clock.seconds
        for k in range(11):
            clock.seconds = began + seconds * k / 10
            forecast.at(step, what, total * k // 10, total)
            assert forecast.left() == pytest.approx(22 - (clock.seconds - 100), abs=0.01)


def test_a_slower_computer_shows_in_all_that_is_left() -> None:
    clock = Clock()
    forecast = Forecast(parts(), clock)
    forecast.at("prepare", "looking", 0, 60)
    clock.seconds += 12  # in place of 4
    forecast.at("prepare", "writing", 0, 60)
    assert forecast.left() > 1.4 * 18
    for done in range(1, 61):
        clock.seconds += 0.3  # in place of 0.1
        forecast.at("prepare", "writing", done, 60)
    assert 12 * 2 < forecast.left() < 12 * 3.01


def test_time_without_news_counts_too() -> None:
    clock = Clock()
    forecast = Forecast(parts(), clock)
    clock.seconds += 3
    assert forecast.left() == pytest.approx(22 - 3)
    clock.seconds += 30
    assert forecast.left() >= 18  # what comes after is not shortened by it


def test_a_part_that_turns_out_longer_counts_with_its_length() -> None:
    forecast = Forecast(parts()[2:], Clock())
    forecast.at("train", "training", 0, 1000)
    assert forecast.left() == pytest.approx(20 + 2)


def test_what_a_resumed_part_had_done_before_tells_no_speed() -> None:
    clock = Clock()
    forecast = Forecast(parts()[2:], clock)
    forecast.at("train", "training", 400, 500)
    clock.seconds += 1
    forecast.at("train", "training", 450, 500)
    assert forecast.left() == pytest.approx(1 + 2, abs=0.1)


def test_the_end_has_nothing_left() -> None:
    clock = Clock()
    forecast = Forecast(parts()[2:3], clock)
    clock.seconds += 10
    forecast.at("train", "training", 500, 500)
    assert forecast.left() == 0
    assert Forecast([], clock).left() == 0


def test_a_training_that_starts_at_half_resolution_does_not_promise_too_little() -> None:
    cfg = preset("default")
    clock, mpx = Clock(), 0.33
    seconds, count = training_seconds(cfg, mpx), iterations(cfg)
    half = cfg.schedule.half_resolution_iterations
    assert seconds(half) / half < 0.5 * (seconds(count) - seconds(half)) / (count - half)
    forecast = Forecast([Part("train", "training", seconds, count)], clock)
    for done in range(1, half):
        clock.seconds = 100 + 1.3 * seconds(done)
        forecast.at("train", "training", done, count)
    assert forecast.left() == pytest.approx(1.3 * (seconds(count) - seconds(half)), rel=0.1)


def test_windows_follow_one_another() -> None:
    cfg = replace(preset("default"), schedule=replace(preset("default").schedule, fine_iterations=1000))
    seconds, count = training_seconds(cfg, 0.1), iterations(cfg)
    assert seconds(3 * count) == pytest.approx(3 * seconds(count))
    assert seconds(count + 10) - seconds(count) == pytest.approx(seconds(10))
