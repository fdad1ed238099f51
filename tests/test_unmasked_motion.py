"""Motion that no mask explains: the decision on two frames, the frames of a sequence, and where it is said."""

from __future__ import annotations

import json

import cv2
import numpy as np
import pytest

from endoprior.data.found_tools import FILE, FrameRow, drop_rows, mark_moving, read_rows, write_rows
from endoprior.footage.optical_flow import difference_from_background
from endoprior.prepare.unmasked_motion import frames_with_unmasked_motion, moves_unmasked
from endoprior.runs.log import missed_tools_line

SHAPE = (160, 200)
VIEW = np.ones(SHAPE, bool)
NOWHERE = ~VIEW


def texture(seed: int, shape=SHAPE) -> np.ndarray:
    """(h, w, 3) 0..255: something that flow can follow."""
    rng = np.random.default_rng(seed)
    noise = sum(cv2.GaussianBlur(rng.normal(size=shape), (0, 0), s) * s for s in (1.5, 4.0, 9.0))
    gray = 120 + 40 * noise / noise.std()
    return np.stack([gray, 0.6 * gray, 0.6 * gray], -1).clip(0, 255).astype(np.uint8)


def shaft(reach: int) -> np.ndarray:
    """A tool that has come in from the left that far, px."""
    mask = NOWHERE.copy()
    mask[70:92, :reach] = True
    return mask


def pair(step: int = 6, shift: int = 0, angle: float = 0.0):
    """Two frames: the background shifts and turns, a tool that is 90 px in goes on by `step`."""
    tissue = texture(0, (SHAPE[0] + 60, SHAPE[1] + 60))
    turn = cv2.getRotationMatrix2D((130, 110), angle, 1) + np.array([[0, 0, shift], [0, 0, 0]])
    moved = cv2.warpAffine(tissue, turn, tissue.shape[1::-1])
    first, later = (image[30:-30, 30:-30].copy() for image in (tissue, moved))
    tool = np.roll(texture(1), 0, 1)[..., ::-1]
    first[shaft(90)] = tool[shaft(90)]
    later[shaft(90 + step)] = np.roll(tool, step, 1)[shaft(90 + step)]
    return first, later


@pytest.mark.parametrize(("shift", "angle"), [(0, 0), (5, 0), (-4, 1.0), (0, 2.0)])
def test_a_tool_that_moves_is_seen_before_any_smooth_background(shift, angle):
    first, later = pair(8, shift, angle)
    assert moves_unmasked(first, later, VIEW, NOWHERE)
    assert not moves_unmasked(first, later, VIEW, shaft(98))


@pytest.mark.parametrize(
    "why", ["rests", "hardly moves", "same motion", "inside", "outside the view", "cut", "haze", "all masked", "tiny"]
)
def test_other_motion_is_not_reported(why):
    view, tool, (first, later) = VIEW, NOWHERE, pair(8)
    if why == "rests":
        first, later = pair(0)
    elif why == "hardly moves":
        first, later = pair(1)
    elif why == "same motion":
        first = texture(0)
        later = np.roll(first, 5, 1)
    elif why == "inside":  # tissue that is pulled does not enter from the border
        first, later = texture(0), texture(0)
        first[60:100, 60:110], later[60:100, 60:110] = texture(1)[60:100, 60:110], texture(1)[60:100, 52:102]
    elif why == "outside the view":
        view = VIEW.copy()
        view[:, :120] = False
    elif why == "cut":
        later = texture(5)
    elif why == "haze":  # much of the view has nothing in common
        first, later = texture(0), texture(0)
        later[55:120, :140] = texture(5)[55:120, :140]
    elif why == "all masked":
        tool = VIEW
    else:
        first, later, view, tool = (each[:20, :20] for each in (first, later, view, tool))
    assert not moves_unmasked(first, later, view, tool)


def test_a_quadratic_motion_is_background_however_the_rest_moves():
    y, x = np.mgrid[: SHAPE[0], : SHAPE[1]] / 100.0
    flow = np.stack([1 + x - 2 * y + x * y, 3 * x * x - y * y], -1).astype(np.float32)
    moving = shaft(90)
    flow[moving] += 9
    difference, usual = difference_from_background(flow, VIEW)
    assert usual < 0.05 and np.allclose(difference[moving], 9 * 2**0.5, atol=0.3) and difference[~moving].max() < 0.3


def test_a_few_frames_of_a_sequence_are_compared_with_a_later_one():
    frames = [texture(0) for _ in range(40)]
    for i, frame in enumerate(frames):  # enters from frame 20 on
        reach = max(0, 6 * (i - 20))
        frame[shaft(reach)] = np.roll(texture(1), reach, 1)[..., ::-1][shaft(reach)]
    asked: list[int] = []

    def color(i):
        asked.append(i)
        return frames[i]

    def nothing(i):
        return NOWHERE

    found = frames_with_unmasked_motion(40, 10.0, color, nothing, VIEW)
    assert found and min(found) > 20 and len(asked) <= 48 and max(asked) == 39
    masked = frames_with_unmasked_motion(40, 10.0, color, lambda i: shaft(max(0, 6 * (i - 20))), VIEW)
    assert masked == [] and frames_with_unmasked_motion(2, 30.0, color, nothing, VIEW) == []


def test_the_frames_are_noted_and_named_once_with_those_of_training(tmp_path):
    write_rows(tmp_path, [FrameRow(i, 0.1, 0.9) for i in range(6)])
    before = (tmp_path / FILE).read_text()
    mark_moving(tmp_path, [])
    assert (tmp_path / FILE).read_text() == before and "moves" not in before
    mark_moving(tmp_path, [1, 3])
    assert [row.frame for row in read_rows(tmp_path) if row.moves_unmasked] == [1, 3]
    run = tmp_path / "RUN"
    run.mkdir()
    (run / "log.jsonl").write_text(json.dumps({"missed_tool_frames": [2, 3]}) + "\n")
    line = missed_tools_line(run, tmp_path)
    assert "in frames 1-3." in line and line.count("\n") == 0
    drop_rows(tmp_path, [1])  # a person has corrected it
    assert "in frames 2-3" in missed_tools_line(run, tmp_path)
    (run / "log.jsonl").write_text("{}\n")  # the masks were trusted
    assert missed_tools_line(run, tmp_path) == ""
    (tmp_path / FILE).write_text("[")
    (run / "log.jsonl").write_text(json.dumps({"missed_tool_frames": [2]}) + "\n")
    assert "in frame 2." in missed_tools_line(run, tmp_path)


def test_an_added_tool_answers_the_doubt():
    row = FrameRow(0, 0.9, 0.5, moves_unmasked=True)
    assert row.with_added(0.2) == FrameRow(0, 1.0, 0.5) and row.with_added(0) == row
