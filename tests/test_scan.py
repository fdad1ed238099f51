"""`endoprior scan`: every disturbance of a phantom is found at its frames, and nothing else is."""

import json
import math
import shutil

import cv2
import numpy as np
import pytest

from endoprior.cli import main
from endoprior.data.images import read_color, save_png
from endoprior.footage.changes import find_changes
from endoprior.footage.scenes import breaks, half_stays, jumps, places_differ, standardized
from endoprior.phantom import PhantomConfig, write_phantom
from endoprior.pipeline.choice import choose_segment
from endoprior.prepare.scan import scan_video
from endoprior.prepare.scan_figure import CURVES, draw_scan
from endoprior.prepare.segments import as_json, best_start, from_json, stretches_of

RATE = 10.0
EVENTS = "blur:12-17,white-out:30-37,out-of-body:60-74,cut:90"
SMALL = {"frames": 110, "width": 160, "height": 128, "side_views": False, "noise": 1.0, "tracks": 8}


@pytest.fixture(scope="module")
def disturbed(tmp_path_factory):
    folder = tmp_path_factory.mktemp("phantom") / "data"
    write_phantom(folder, PhantomConfig(events=EVENTS, **SMALL))
    return folder


@pytest.fixture(scope="module")
def scan(disturbed):
    return scan_video(disturbed / "images", RATE)


def test_every_event_is_found_at_its_frames_and_nothing_else(scan, disturbed):
    events = json.loads((disturbed / "truth" / "scene.json").read_text())["events"]
    assert [event["kind"] for event in events] == ["blur", "white-out", "out-of-body", "cut"]
    words = np.array([frame.word for frame in scan.frames])
    for word, first, last in (("blur", 12, 17), ("overexposed", 30, 37), ("out of the body", 60, 74)):
        assert np.flatnonzero(words == word).tolist() == list(range(first, last + 1)), word
    assert {*words} == {"", "blur", "overexposed", "out of the body"}
    assert [round(time * RATE) for time in scan.cuts] == [90]
    weights = np.array([frame.weight for frame in scan.frames])
    assert ((weights < 1) == (words != "")).all()


def test_segments_are_what_lies_between_them(scan):
    found = [(each.reason, round(each.start * RATE), round(each.end * RATE)) for each in stretches_of(scan)]
    assert found == [
        ("", 0, 12), ("blur", 12, 18), ("", 18, 30), ("overexposed", 30, 38), ("", 38, 60),
        ("out of the body", 60, 75), ("", 75, 90), ("", 90, 110),
    ]  # fmt: skip
    stored = from_json(as_json(scan))
    assert [(each.reason, each.start) for each in stored] == [(each.reason, each.start) for each in stretches_of(scan)]


def test_the_longest_clear_segment_is_chosen_and_a_scan_is_kept(disturbed, tmp_path):
    choice = choose_segment(disturbed / "images", tmp_path, RATE)
    assert [round(time * RATE) for time in choice.span] == [38, 60]
    lines = choice.words(disturbed / "images", tmp_path / "out")
    assert "segment 3 of 5" in lines[0]
    assert "blur 0.6 s" in lines[1]
    assert all("--segment" in line for line in lines[2:5])
    (tmp_path / "scan.json").write_text(json.dumps(choice.scanned | {"cuts": [0.25]}))
    again = choose_segment(disturbed / "images", tmp_path / "out", RATE, 2)
    assert again.scanned["cuts"] == [0.25]
    assert [round(time * RATE) for time in again.span] == [18, 30]


def test_a_segment_that_is_not_there_is_named(disturbed, tmp_path, capsys):
    words = ["run", str(disturbed / "images"), str(tmp_path / "out"), "--folder-rate", "10", "--segment", "6"]
    assert main(words) == 2
    assert "--segment: expected the number of a segment, got 6, with 5 in" in capsys.readouterr().err
    assert not (tmp_path / "out").exists()
    assert main([*words, "--start", "1"]) == 2
    assert "--segment: expected no --start" in capsys.readouterr().err


def test_a_clear_phantom_is_one_segment_and_used_as_a_whole(tmp_path):
    write_phantom(tmp_path / "data", PhantomConfig(**SMALL | {"frames": 40}))
    choice = choose_segment(tmp_path / "data" / "images", tmp_path, RATE)
    assert (choice.number, choice.words(tmp_path, tmp_path)) == (0, [])
    assert len(choice.stretches) == 1
    changes = find_changes(read_color(file) for file in sorted((tmp_path / "data" / "images").iterdir()))
    assert (changes.cuts, changes.off_color, changes.weights.min()) == ((), (), 1.0)


def test_smoke_is_no_cut_and_lowers_weights(tmp_path):
    write_phantom(tmp_path / "data", PhantomConfig(**SMALL | {"frames": 40}, tissue="smoke"))
    density = np.array(json.loads((tmp_path / "data" / "truth" / "scene.json").read_text())["smoke"])
    changes = find_changes(read_color(file) for file in sorted((tmp_path / "data" / "images").iterdir()))
    assert (changes.cuts, changes.off_color) == ((), ())
    assert (density[changes.weights < 1] > 0.3).all()


def test_the_weights_of_a_sequence_fall_where_it_is_blurred(disturbed):
    images = [read_color(file) for file in sorted((disturbed / "images").iterdir())]
    changes = find_changes(images)
    low = np.flatnonzero(changes.weights < 1)
    assert {*range(12, 18), *range(30, 38)} <= {*low.tolist()} <= {*range(12, 18), *range(30, 38), *range(60, 75)}
    assert set(changes.off_color) >= set(range(60, 75))


def test_a_still_image_and_a_dark_one_are_no_video(disturbed, tmp_path):
    images = sorted((disturbed / "images").iterdir())
    dark = np.full((128, 160, 3), 5, np.uint8)
    order = [*images[38:50], *[images[50]] * 13, *images[51:60]]
    for i, file in enumerate(order):
        shutil.copy(file, tmp_path / f"{i:04d}.png")
    for i in range(len(order), len(order) + 6):
        save_png(tmp_path / f"{i:04d}.png", dark)
    words = [frame.word for frame in scan_video(tmp_path, RATE).frames]
    assert words == [""] * 13 + ["repeated frames"] * 12 + [""] * 9 + ["dark"] * 6


def test_a_cut_needs_a_jump_that_no_pair_of_images_bridges():
    assert breaks(6, [(0, 1), (1, 3), (4, 5)]).tolist() == [False, False, False, False, True, False]
    seconds = np.arange(20) / 10
    fast = np.full(20, 0.4)
    assert not jumps(seconds, fast).any(), "a camera that moves fast all the time"
    assert np.flatnonzero(jumps(seconds, np.where(seconds == 1.0, 0.9, 0.05))).tolist() == [10]


def test_a_view_that_comes_back_stays_in_half_or_never_lasts_is_no_other_place():
    noise = np.random.default_rng(0).normal(size=(20, 51, 64)).astype(np.float32)
    one, other, *rest = (standardized(cv2.GaussianBlur(each, (0, 0), 4) * 500) for each in noise)
    assert places_differ([one] * 6, [other] * 6)
    assert places_differ([one], [rest[0], *[other] * 5]), "a flash at the cut"
    assert not places_differ([one] * 6, [other, other, *[one] * 4]), "a jerk that returns"
    assert not places_differ([one] * 6, rest[:6]), "a sweep"
    assert not places_differ([one] * 6, [np.hstack([other[:, :32], one[:, 32:]])] * 6), "a fold"
    assert not half_stays(one, other) and half_stays(one, np.roll(one, 2, 1)), "a small shift"


def test_the_command_writes_both_files_and_names_the_next_one(disturbed, tmp_path, capsys):
    out = tmp_path / "found.json"
    assert main(["scan", str(disturbed / "images"), str(out), "--folder-rate", "10"]) == 0
    text = capsys.readouterr().out
    assert "segment 3, score" in text
    assert "out of the body" in text
    assert "endoprior run" in text
    assert out.with_suffix(".png").stat().st_size > 10_000
    assert json.loads(out.read_text())["best_segment"] == 3


@pytest.mark.parametrize("events", ["fog:1-2", "blur:9-3", "blur:5-400", "cut"])
def test_bad_events_are_named(events, tmp_path, capsys):
    assert main(["phantom", str(tmp_path / "data"), "--events", events]) == 2
    assert "--events" in capsys.readouterr().err
    assert not (tmp_path / "data").exists()


def looked(weights, problems=(), unknown=(), rate=5.0):
    """What `scan.json` holds of so many looks."""
    count = len(weights)
    looks = {
        "seconds": [i / rate for i in range(count)],
        "weight": list(weights),
        "problem": ["blur" if i in problems else "" for i in range(count)],
        "shift": [None if i in unknown else 0.01 for i in range(count)],
    }
    return {"seconds": count / rate, "looks": looks}


def test_the_best_seconds_of_a_span_are_those_that_are_clear_and_followed():
    clear = looked([1.0] * 50)
    assert best_start(clear, (0.0, math.inf), 3.0) == 0.0 and best_start(clear, (2.0, 9.0), 3.0) == 2.0
    assert best_start(looked([1.0] * 50, problems=range(10, 30)), (1.0, 10.0), 3.0) == 6.0
    assert best_start(looked([0.5] * 20 + [1.0] * 30), (0.0, 10.0), 3.0) == 4.0
    assert best_start(looked([1.0] * 50, unknown=range(25)), (0.0, 10.0), 3.0) == 5.0
    assert best_start(clear, (0.0, 10.0), 30.0) == 0.0 and best_start(clear, (11.0, 12.0), 1.0) == 11.0


def test_the_best_seconds_are_those_of_a_slow_loop():
    rng = np.random.default_rng(0)
    for _ in range(30):
        weights = rng.random(40).round(2)
        scanned, seconds = looked(weights), int(rng.integers(2, 20)) / 5
        length = round(seconds * 5)
        means = [float(np.mean(weights[i : i + length])) for i in range(40 - length + 1)]
        found = best_start(scanned, (0.0, 8.0), seconds)
        assert means[round(found * 5)] >= max(means) - 0.01  # the first of nearly equal ones


@pytest.mark.parametrize("count", [5, 15, 24])
def test_the_images_of_the_timeline_are_spread_over_the_whole_video(count, tmp_path, monkeypatch):
    images, shown = [np.full((8, 10, 3), i, np.uint8) for i in range(count)], []
    monkeypatch.setattr("matplotlib.axes.Axes.imshow", lambda _axes, image: shown.append(int(image.max())))
    looks = {name: [0.5, 0.5] for name in ("seconds", "shift", *CURVES)}
    scanned = {"seconds": 1.0, "looks": looks, "cuts": [], "segments": [], "not_usable": []}
    draw_scan(tmp_path / "video.mp4", scanned, tmp_path / "scan.png", pictures=images)
    assert shown[0] == 0 and shown[-1] == count - 1 and len(shown) == min(count, 8)
