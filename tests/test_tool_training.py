"""Composites and that they repeat; the training, that it learns and resumes; the counts of the benchmark."""

from __future__ import annotations

import math
from itertools import pairwise

import cv2
import numpy as np
import pytest
import torch

from endoprior.core.checks import InputError
from endoprior.tool_masks.network import InvertedResidual, ToolNetwork
from endoprior_studies.tool_training import benchmark, camera, composites, footage
from endoprior_studies.tool_training.benchmark import Counts, TestFrame, count, pictures, score_set
from endoprior_studies.tool_training.camera import photographed, random_view
from endoprior_studies.tool_training.composites import IGNORED, SIZE, LabeledFrame, examples
from endoprior_studies.tool_training.fit import RATE, Examples, fit, loss_of, pretrained, rate_of
from endoprior_studies.tool_training.foreign_bodies import gauze, needle, ribbed_tube
from endoprior_studies.tool_training.instruments import NEAR_WIDTH_PX, instrument
from endoprior_studies.tool_training.noise import fractal_field, smooth_field
from endoprior_studies.tool_training.scope_tools import cap, catheter, clips
from endoprior_studies.tool_training.tissue import LIT_PARTS, MATTE_PARTS, tissue

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


@pytest.mark.parametrize("paint", [cap, catheter, clips])
def test_what_a_scope_carries_is_painted_where_its_label_is(paint):
    shares = []
    for seed in range(12):
        scene = np.full((*SIZE, 3), (0.6, 0.25, 0.2), np.float32)
        body, again = (paint(np.random.default_rng(seed), scene, np.ones(SIZE, bool)) for _ in range(2))
        assert (body.color == again.color).all() and (body.covered == again.covered).all()
        assert (scene == np.float32([0.6, 0.25, 0.2])).all() and np.isfinite(body.color).all()
        assert body.covered.min() >= 0 and body.covered.max() <= 1 and (body.outline >= body.covered - 1e-6).all()
        on_it = body.covered > 0.5
        if on_it.any():
            assert np.abs(body.color - scene)[on_it].mean() > 0.02  # it can be seen
        shares.append(on_it.mean())
    assert {cap: 0.05, catheter: 0.005, clips: 0.001}[paint] < np.median(shares) < 0.35


def test_a_cap_is_a_wall_at_the_border_around_tissue():
    for seed in range(20):
        covered = cap(np.random.default_rng(seed), np.zeros((*SIZE, 3), np.float32), np.ones(SIZE, bool)).covered > 0.5
        inside, walls = (cv2.connectedComponents(part.astype(np.uint8))[0] - 1 for part in (~covered, covered))
        middle = covered[SIZE[0] // 2 - 8 : SIZE[0] // 2 + 8, SIZE[1] // 2 - 8 : SIZE[1] // 2 + 8]
        assert not middle.any() and inside == 1 and walls <= 4  # four corners at most
        rim = np.concatenate([covered[0], covered[-1], covered[:, 0], covered[:, -1]])
        assert rim.any()


def test_shafts_close_to_the_camera_are_wide():
    near, usual = (
        np.median([(instrument(np.random.default_rng(s), scene, whole, *w).covered > 0.5).mean() for s in range(12)])
        for w in ((NEAR_WIDTH_PX,), ())
        for scene, whole in [(np.zeros((*SIZE, 3), np.float32), np.ones(SIZE, bool))]
    )
    assert near > 2 * usual


@pytest.mark.parametrize("add", [add for add, _ in (*MATTE_PARTS, *LIT_PARTS)], ids=lambda add: add.__name__)
def test_parts_of_tissue_change_a_part_of_it(add):
    scene = np.full((*SIZE, 3), (0.5, 0.2, 0.15), np.float32)
    made = [add(np.random.default_rng(seed), scene) for seed in range(8)]
    assert all(image.shape == scene.shape and np.isfinite(image).all() for image in made)
    changed = [(np.abs(image - scene).max(-1) > 0.02).mean() for image in made]
    assert 0 < np.mean(changed) < 1 and (scene == np.float32([0.5, 0.2, 0.15])).all()


def test_smoke_pales_all_alike_and_hides_nothing_entirely():
    dark, light = (np.full((*SIZE, 3), level, np.float32) for level in (0.1, 0.9))
    shares = []
    for seed in range(20):
        first, second = (camera.smoked(np.random.default_rng(seed), image) for image in (dark, light))
        left = (second - first) / 0.8
        assert left.min() >= 1 - camera.MAX_SMOKE - 1e-5 and left.max() <= 1 + 1e-5
        shares.append(1 - left.mean())
    assert max(shares) > 0.5 and min(shares) < 0.3


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


def test_single_frames_are_read_with_their_masks(tmp_path):
    for name in ("sisvse_gastrectomy", "cataract1k"):
        for kind in ("images", "masks"):
            (tmp_path / "tools_more" / name / kind).mkdir(parents=True)
        label = np.zeros((200, 300), np.uint8)
        label[100:110, 50:60] = 255
        cv2.imwrite(str(tmp_path / "tools_more" / name / "images" / "000.jpg"), np.full((200, 300, 3), 90, np.uint8))
        cv2.imwrite(str(tmp_path / "tools_more" / name / "masks" / "000.png"), label)
    (_, _, whole), (_, _, near) = (next(footage.SETS[n](tmp_path)) for n in ("sisvse_gastrectomy", "cataract1k"))
    assert (whole == (label > 0)).all()
    assert (near[label > 0] == 1).all() and near[95, 45] == 0 and near[0, 0] == near[105, 200] == IGNORED


def test_frames_of_a_small_set_are_not_shown_as_often_as_all_others():
    few, many = [real_frame(0)], [real_frame(i) for i in range(1, 10)]
    rng = np.random.default_rng(0)
    chosen = [composites.any_frame(rng, [few, many]) is few[0] for _ in range(400)]
    assert 0.19 < np.mean(chosen) < 0.31  # one to the root of nine


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


def lite0_of(network):
    """The weights of a network's way down under the names of EfficientNet-Lite0."""
    named, norms = {"_conv_stem.weight": network.stem[1].weight[:, :3]}, {"_bn0": network.stem[2]}
    blocks = [block for block in network.down.modules() if isinstance(block, InvertedResidual)]
    for k, block in enumerate(blocks):
        if len(list(block.expand.children())):
            named[f"_blocks.{k}._expand_conv.weight"] = block.expand[1].weight
            norms[f"_blocks.{k}._bn0"] = block.expand[2]
        named[f"_blocks.{k}._depthwise_conv.weight"] = block.filter[1].weight
        named[f"_blocks.{k}._project_conv.weight"] = block.project[0].weight
        norms[f"_blocks.{k}._bn1"], norms[f"_blocks.{k}._bn2"] = block.filter[2], block.project[1]
    for name, norm in norms.items():
        named |= {f"{name}.{part}": getattr(norm, part) for part in ("weight", "bias", "running_mean", "running_var")}
    return named


def test_a_training_starts_from_the_way_down_of_a_file(tmp_path):
    file = tmp_path / "lite0.pth"
    weights = {name: torch.full_like(each, k) for k, (name, each) in enumerate(lite0_of(ToolNetwork()).items())}
    torch.save(weights, file)
    network = pretrained(file, 0)
    copied = lite0_of(network)
    assert copied.keys() == weights.keys() and all((copied[name] == weights[name]).all() for name in weights)
    assert not network.stem[1].weight[:, 3:].any()
    same = pretrained(file, 0).up[0][1].weight
    assert (same == network.up[0][1].weight).all() and (same != pretrained(file, 1).up[0][1].weight).any()


@pytest.mark.parametrize("content", [None, b"nothing", {"_conv_stem.weight": torch.zeros(2)}, [1, 2]])
def test_a_file_of_something_else_ends_in_one_line(tmp_path, content):
    file = tmp_path / "weights.pth"
    if isinstance(content, bytes):
        file.write_bytes(content)
    elif content is not None:
        torch.save(content, file)
    with pytest.raises(InputError, match="EfficientNet-Lite0") as error:
        pretrained(file, 0)
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
            return type("Found", (), {"tool_mask": mask})

    nothing = np.zeros((32, 64), bool)
    frames = [
        TestFrame(f"{n}", np.full((32, 64, 3), n, np.uint8), ~nothing, nothing, ~nothing) for n in (40, 0, 10, 20, 30)
    ]
    score = score_set(Finder(), frames)
    assert [frame.name for frame, _ in score.shown] == ["0", "20", "40"]
    shown = dict(pictures(score))
    assert (shown["0"] == 0).all() and shown["40"][0, 0, 2] > shown["40"][0, 0, 0]
    assert benchmark.SHOWN == 3
