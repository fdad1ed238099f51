"""Composites and that they repeat; the training, that it learns and resumes; the counts of the benchmark."""

from __future__ import annotations

import math
from itertools import pairwise

import cv2
import numpy as np
import pytest
import torch
from safetensors.torch import save

from endoprior.core.checks import InputError
from endoprior.tool_masks.network import ToolNetwork, network_from_file
from endoprior_studies.tool_training import benchmark, composites
from endoprior_studies.tool_training.benchmark import Counts, TestFrame, count, pictures, score_set
from endoprior_studies.tool_training.camera import photographed, random_view
from endoprior_studies.tool_training.composites import IGNORED, SIZE, LabeledFrame, examples
from endoprior_studies.tool_training.fit import RATE, Examples, fit, loss_of, rate_of
from endoprior_studies.tool_training.foreign_bodies import gauze, needle, ribbed_tube
from endoprior_studies.tool_training.instruments import instrument
from endoprior_studies.tool_training.noise import fractal_field, smooth_field
from endoprior_studies.tool_training.tissue import tissue

TestFrame.__test__ = False


def real_frame(seed=0):
    """A frame with a gray bar as its tool, and an ignored corner."""
    rng = np.random.default_rng(seed)
    rgb_u8 = (tissue(rng, (150, 200)) * 255).astype(np.uint8)
    label = np.zeros((150, 200), np.uint8)
    label[60:90, :120] = 1
    label[:20, :30] = IGNORED
    rgb_u8[label == 1] = (120, 125, 130)
    return LabeledFrame(rgb_u8, label)


@pytest.mark.parametrize("spot_px", [2, 5, 40, 300])
def test_noise_has_the_size_and_spread_that_it_says(spot_px):
    many = np.stack([smooth_field(np.random.default_rng(i), (60, 90), spot_px) for i in range(60)])
    assert many.shape[1:] == (60, 90) and abs(many.mean()) < 0.25 and 0.5 < many.std() < 1.2
    rough = fractal_field(np.random.default_rng(0), (60, 90), spot_px, 5)
    assert rough.shape == (60, 90) and np.isfinite(rough).all()


@pytest.mark.parametrize("seed", range(6))
def test_tissue_is_an_image(seed):
    image = tissue(np.random.default_rng(seed), (70, 90))
    assert image.shape == (70, 90, 3) and image.min() >= 0 and image.max() <= 1 and image.std() > 0.01


def tube(rng, scene, view):
    return ribbed_tube(rng, scene)[1]


@pytest.mark.parametrize(
    "paint", [instrument, tube, *(pytest.param(each, marks=pytest.mark.slow) for each in (gauze, needle))]
)
def test_bodies_are_painted_inside_of_what_they_cover(paint):
    shares = []
    for seed in range(12):
        rng = np.random.default_rng(seed)
        scene = tissue(rng, SIZE)
        before = scene.copy()
        body = paint(rng, scene, np.ones(SIZE, bool))
        assert (scene == before).all()  # painting is done by `examples`
        assert np.isfinite(body.color).all()
        assert body.covered.min() >= 0 and body.covered.max() <= 1 and (body.outline >= body.covered - 1e-6).all()
        shares.append((body.covered > 0.5).mean())
    assert 0.002 < np.median(shares) < 0.5


def test_instruments_come_from_the_border():
    touching = 0
    for seed in range(20):
        rng = np.random.default_rng(seed)
        covered = instrument(rng, np.zeros((*SIZE, 3), np.float32), np.ones(SIZE, bool)).covered > 0.5
        rim = np.ones(SIZE, bool)
        rim[2:-2, 2:-2] = False
        touching += (covered & rim).any() or not covered.any()
    assert touching >= 18


@pytest.mark.parametrize("frames", [[], [[real_frame()]]])
def test_examples_repeat_and_hold_what_they_say(frames):
    labels = []
    for seed in range(8):
        first, again = (examples(np.random.default_rng(seed), frames) for _ in range(2))
        for one, other in zip(first, again, strict=True):
            assert (one.rgb_u8 == other.rgb_u8).all() and (one.label == other.label).all()
            assert one.rgb_u8.shape == (*SIZE, 3) and one.rgb_u8.dtype == np.uint8
            assert set(np.unique(one.label)) <= {0, 1, IGNORED} and (one.label[~one.view] == IGNORED).all()
            labels.append(one.label)
    assert 0.02 < (np.stack(labels) == 1).mean() < 0.6


def test_two_photographs_show_one_scene():
    one, two = examples(np.random.default_rng(3), [], 2)
    assert np.isclose((one.label == 1).sum(), (two.label == 1).sum()) and (one.rgb_u8 != two.rgb_u8).any()


@pytest.mark.parametrize("seed", range(10))
def test_beyond_the_view_nothing_of_the_scene_is_seen(seed):
    view = random_view(np.random.default_rng(seed), SIZE)
    assert view.mean() > 0.3
    dark, light = (
        photographed(np.random.default_rng(seed), np.full((*SIZE, 3), level, np.float32), view) for level in (0.2, 0.8)
    )
    far = ~(cv2.dilate(view.astype(np.uint8), np.ones((33, 33), np.uint8)) > 0)  # JPEG blocks reach over the border
    assert (dark != light).any() and (dark == light)[far].all()


@pytest.mark.slow
def test_some_borders_are_not_told_and_what_is_beyond_them_is_no_tool():
    told, untold = 0, 0
    for seed in range(60):
        for one in examples(np.random.default_rng(seed), [], 1):
            if not one.view.all():
                told += 1
                assert (one.label[~one.view] == IGNORED).all()
            elif (one.rgb_u8.max(-1) < 16).mean() > 0.1 and not one.label[0, 0]:
                untold += 1
    assert told > 5 and untold > 2


def test_the_lumen_around_a_tube_is_dark_and_the_rest_as_it_was():
    scene = np.full((*SIZE, 3), 0.5, np.float32)
    made = [ribbed_tube(np.random.default_rng(seed), scene)[0] for seed in range(20)]
    darker = [image for image in made if (image < 0.2).any()]
    assert 5 < len(darker) < 20
    assert all(image.max() <= 0.5 for image in darker) and np.mean([(x > 0.45).mean() for x in darker]) > 0.4


def test_the_loss_by_hand():
    label = torch.tensor([[[1, 0], [IGNORED, 0]]], dtype=torch.uint8)
    log_odds = torch.zeros(1, 2, 2)
    # Three known pixels at probability one half; soft overlap (2 * 0.5 + 100) / (1.5 + 1 + 100).
    assert loss_of(log_odds, label).item() == pytest.approx(math.log(2) + 0.5 * (1 - 101 / 102.5), rel=1e-5)
    wild = log_odds.clone()
    wild[0, 1, 0] = 50.0
    assert loss_of(wild, label).item() == pytest.approx(loss_of(log_odds, label).item())


def test_the_rate_rises_and_falls():
    rates = [rate_of(step, 200) for step in range(200)]
    assert max(rates) == RATE and rates.index(RATE) in (9, 10) and rates[0] == RATE / 10
    assert rates[-1] < RATE / 1000 and all(a >= b for a, b in pairwise(rates[10:]))


def test_examples_are_padded_and_ignored_there(monkeypatch):
    monkeypatch.setattr(composites, "SIZE", (150, 190))
    image, label = Examples([], 0, 2)[1]
    assert not image[:, :, 150:].any() and (label[:, :, 190:] == IGNORED).all()
    assert image.shape == (2, 6, 160, 192) and label.shape == (2, 160, 192)


@pytest.mark.slow
def test_training_learns_and_resumes_bit_identically(tmp_path, monkeypatch):
    monkeypatch.setattr("endoprior_studies.tool_training.fit.REPORTED", 6)
    losses = []

    def train(checkpoint, stop=None):
        def report(step, loss):
            losses.append(loss)
            if step == stop:
                raise KeyboardInterrupt

        return fit([[real_frame()]], 12, checkpoint=checkpoint, workers=0, report=report)

    whole = train(tmp_path / "a").state_dict()
    assert losses[-1] < losses[0]
    with pytest.raises(KeyboardInterrupt):
        train(tmp_path / "b", stop=12)  # after the checkpoint of step 6 was written
    resumed = train(tmp_path / "b").state_dict()
    assert all(torch.equal(whole[name], resumed[name]) for name in whole)


def test_training_goes_on_from_given_weights():
    start = ToolNetwork()
    with torch.no_grad():
        start.out[0].bias.fill_(3.0)
    same = fit([], 0, start=start, workers=0)
    assert same is not start
    assert all((old == new).all() for old, new in zip(start.parameters(), same.parameters(), strict=True))


@pytest.mark.parametrize("content", [None, b"nothing", save({"down.0.0.0.weight": torch.zeros(2)})])
def test_weights_that_are_none_end_in_one_line(tmp_path, content):
    file = tmp_path / "weights.safetensors"
    if content is not None:
        file.write_bytes(content)
    with pytest.raises(InputError, match="weights") as error:
        network_from_file(file)
    assert "\n" not in str(error.value)


def test_counts_by_hand():
    tools = np.zeros((64, 640), bool)
    tools[:, :100] = True
    counted = np.ones_like(tools)
    counted[:, 600:] = False
    found = np.zeros_like(tools)
    found[:, 80:120] = True
    found[:, 590:] = True
    counts = count(found, TestFrame("", np.zeros((64, 640, 3), np.uint8), np.ones_like(tools), tools, counted))
    # The rim is 6 px: the core ends at column 94, and up to column 106 nothing is false.
    assert counts.core == 64 * 94 and counts.core_missed == 64 * 80
    assert counts.beside == 64 * (600 - 106) and counts.false == 64 * (14 + 10)
    assert counts.hit == 64 * 20 and counts.either == 64 * (120 + 10) and counts.tool_free_frames == 0


def test_frames_without_tools_are_counted():
    nothing = np.zeros((64, 64), bool)
    frame = TestFrame("", np.zeros((64, 64, 3), np.uint8), ~nothing, nothing, ~nothing)
    spot = nothing.copy()
    spot[:4, :4] = True
    total = count(nothing, frame) + count(spot, frame)
    assert (total.tool_free_frames, total.false_tools) == (2, 1)
    scores = total.scores()
    assert scores["false_frames"] == 0.5 and math.isnan(scores["iou"]) and math.isnan(scores["missed_core"])
    assert math.isnan(Counts().scores()["false_area"])


def test_the_best_a_middle_and_the_worst_frame_are_shown():
    class Finder:
        def find(self, rgb_u8, view):
            mask = np.zeros_like(view)
            mask[:, : rgb_u8[0, 0, 0]] = True
            return type("Found", (), {"mask": mask})

    nothing = np.zeros((32, 64), bool)
    frames = [
        TestFrame(f"{n}", np.full((32, 64, 3), n, np.uint8), ~nothing, nothing, ~nothing) for n in (40, 0, 10, 20, 30)
    ]
    score = score_set(Finder(), frames)
    assert [frame.name for frame, _ in score.shown] == ["0", "20", "40"]
    shown = dict(pictures(score))
    assert (shown["0"] == 0).all() and shown["40"][0, 0, 2] > shown["40"][0, 0, 0]
    assert benchmark.SHOWN == 3
