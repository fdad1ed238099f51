"""Which part of a video becomes a scene, and what fits into a player: pure functions."""

import math

import numpy as np
import pytest

from endoprior.cli.progress import Counting, duration
from endoprior.pipeline.job import Part, choose_part
from endoprior.pipeline.steps import every_kth_time, usable_frames
from endoprior.prepare.video import SourceFrame
from endoprior.prepare.video_clip import FrameSelection

WHOLE = (0.0, math.inf)


def even(seconds, rate=25.0):
    """Times of the images of a video without pauses."""
    return [i / rate for i in range(round(seconds * rate))]


@pytest.mark.parametrize(
    ("seconds", "chosen", "most", "part"),
    [
        (10.0, (0.0, *WHOLE), 300, Part(25.0, 0.0, math.inf, 250, True)),
        (20.0, (0.0, *WHOLE), 300, Part(12.5, 0.0, math.inf, 250, True)),  # loses frames in between first,
        (300.0, (0.0, *WHOLE), 300, Part(12.5, 0.0, 299.5 / 12.5, 300, False)),  # then its end
        (300.0, (0.0, *WHOLE), 10_000, Part(12.5, 0.0, math.inf, 3750, True)),
        (300.0, (25.0, 10.0, 12.0), 300, Part(25.0, 10.0, 12.0, 50, True)),
    ],
)
def test_a_video_loses_frames_then_its_end_and_choices_stay(seconds, chosen, most, part):
    assert choose_part(even(seconds), 25.0, *chosen, most=most, usual=300) == part


@pytest.mark.parametrize("start", [0.0, 0.5, 1.23])
@pytest.mark.parametrize("wanted_rate", [0.0, 10.0, 7.0, 50.0])
@pytest.mark.parametrize("end", [2.5, 3.99, 4.0, math.inf])
@pytest.mark.parametrize("most", [20, 60, 300])
def test_it_has_as_many_frames_as_prepare_selects(start, wanted_rate, end, most):
    part = choose_part(even(10.0), 25.0, wanted_rate, start, end, most)
    images = [SourceFrame(i, i / 25, np.empty((1, 1, 3), np.uint8)) for i in range(250)]
    selected = list(FrameSelection(part.frames_per_second, part.start, part.end, 25.0).pick(images))
    assert part.num_frames == len(selected) <= most


def test_the_frame_at_half_a_step_before_the_end_counts():
    assert choose_part(even(10.0), 25.0, 0.0, 0.0, 2.5, most=300).num_frames == 63


@pytest.mark.parametrize("rate", [1.0, 8.0, 10.0, 24.0, 29.97, 60.0, 1000.0])
@pytest.mark.parametrize("num_frames", [0, 2, 59, 60, 61, 1000])
def test_a_part_never_has_too_many_frames_nor_too_low_a_rate(rate, num_frames):
    part = choose_part(even(num_frames / rate, rate), rate, 0.0, *WHOLE, most=60)
    assert part.num_frames <= 60
    assert part.frames_per_second >= min(rate, 10.0)
    if math.isfinite(part.end):
        assert math.floor((part.end - part.start) * part.frames_per_second) + 1 <= 60


def test_a_pause_costs_no_frames():
    times = [*even(2.0), *(60.0 + time for time in even(2.0))]
    assert choose_part(times, 25.0, 0.0, *WHOLE, most=100) == Part(25.0, 0.0, math.inf, 100, True)
    part = choose_part(times, 25.0, 25.0, *WHOLE, most=60)
    assert part == Part(25.0, 0.0, 60 + 9.5 / 25, 60, False)


def test_times_are_those_of_evenly_spaced_frames():
    assert every_kth_time(4, 4) == [0, 0.25, 0.5, 0.75]
    assert every_kth_time(4, 3.9) == [0, 0.5]
    assert every_kth_time(10, 0.2) == [0]


def test_the_longest_stretch_with_a_pose_is_used():
    assert usable_frames(100, [], []) == (0, 100)
    assert usable_frames(100, [33, 60], []) == (0, 100), "single frames are blurred, the camera is not lost"
    assert usable_frames(100, list(range(40, 100)), []) == (0, 40)
    assert usable_frames(100, list(range(40, 100)), [30]) == (0, 30)
    assert usable_frames(100, [], [100, 1000, -150]) == (0, 100), "of another file: there are no such frames"
    assert usable_frames(100, list(range(7, 20)), []) == (20, 100), "the first loss comes early"
    assert usable_frames(100, [0, 1, 99], [60]) == (2, 60)
    assert usable_frames(100, list(range(7, 100)), []) == (0, 100), "too few frames would be left"


def test_durations_are_readable():
    assert [duration(s) for s in (0.4, 42, 100, 120, 3900)] == ["0 s", "42 s", "1 min 40 s", "2 min", "1 h 5 min"]


def test_progress_says_how_long_the_rest_takes(capsys, monkeypatch):
    now = iter((0.0, 5.0, 20.0, 21.0))
    monkeypatch.setattr("endoprior.cli.progress.clock.monotonic", lambda: next(now))
    with Counting("3/6  train: ") as progress:
        for done in (0, 50, 100):
            progress("training", done, 300)
        progress("packing", 0, 0)
    lines = ["training 0/300", "training 100/300  5.0/s  40 s left", "packing"]
    assert capsys.readouterr().out.splitlines() == [f"3/6  train: {line}" for line in lines]
