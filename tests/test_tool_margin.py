"""Pixels that tools color around their masks: how many are measured, which are left out, and that training does it."""

from __future__ import annotations

import json
from dataclasses import replace
from statistics import NormalDist

import cv2
import numpy as np
import pytest
import torch
from hypothesis import given
from hypothesis import strategies as st
from tiny_training import tiny_config

from endoprior.cli import main
from endoprior.data import load_sequence
from endoprior.evaluation.scoring import evaluate
from endoprior.model.presets import preset, preset_names
from endoprior.runs.folder import CONFIG
from endoprior.runs.log import MARGIN, mask_facts
from endoprior.runs.train import start_run, train
from endoprior.tool_masks.margin import (
    LEAST_POINTS,
    MOST,
    WIDTH_PX,
    ColorReach,
    away_from_tools,
    color_reach,
    with_tool_margin,
)
from endoprior.tool_masks.regions import LEAST_SHARE

TISSUE, TOOL = (180, 80, 70), (90, 95, 110)
EDGE = 300


def picture(shape=(120, WIDTH_PX), edge=EDGE, blur=0.0, seed=0, tool=TOOL):
    """(H, W, 3) a tool left of column `edge`, blurred by that standard deviation, with noise of 3 levels."""
    image = np.full((*shape, 3), TISSUE, np.float32)
    image[:, :edge] = tool
    if blur:
        image = cv2.GaussianBlur(image, (0, 0), blur)
    return as_u8(image + np.random.default_rng(seed).normal(0, 3, image.shape))


def as_u8(image):
    return np.rint(image.clip(0, 255)).astype(np.uint8)


def tissue_from(column, shape=(120, WIDTH_PX)):
    tissue = np.ones(shape, bool)
    tissue[:, :column] = False
    return tissue


def reach_of(images, tissue, view=None):
    return color_reach([(image, tissue) for image in images], np.ones_like(tissue) if view is None else view)


def several(**options):
    return [picture(seed=seed, **options) for seed in range(4)]


@pytest.mark.parametrize("wrong", [-3, 0, 1, 2, 3, 4, 5])
def test_a_mask_that_is_too_tight_gets_back_what_it_lacks_and_one_that_is_wide_stays(wrong):
    reach = reach_of(several(), tissue_from(EDGE - wrong))
    assert reach.num_points > LEAST_POINTS and reach.margin_px == min(max(wrong, 0), MOST)


@pytest.mark.parametrize(("blur", "margin"), [(1.0, 1), (1.7, 2), (2.5, 3)])
def test_a_blurred_edge_has_the_shares_of_its_blur(blur, margin):
    reach = reach_of(several(blur=blur), tissue_from(EDGE))
    expected = [NormalDist(0, blur).cdf(0.5 - ring) for ring in range(1, MOST + 1)]
    assert reach.margin_px == margin and reach.shares == pytest.approx(expected, abs=0.04)


@pytest.mark.parametrize(("width", "wrong"), [(160, 1), (320, 2), (1280, 7), (1280, 8), (1280, 9)])
def test_distances_are_scaled_to_the_width_of_the_image(width, wrong):
    shape, edge = (max(width // 4, 80), width), width // 2
    images = [picture(shape, edge, seed=seed) for seed in range(4)]
    most = MOST * width // WIDTH_PX
    assert len(reach_of(images, tissue_from(edge, shape)).shares) == most
    assert reach_of(images, tissue_from(edge - wrong, shape)).margin_px == min(wrong, most)


def test_a_round_edge_is_measured_along_its_normals():
    row, column = np.mgrid[:300, :WIDTH_PX]
    radius = np.hypot(row - 150, column - 320)
    image = np.where((radius < 80)[..., None], TOOL, TISSUE).astype(np.uint8)
    assert reach_of([image] * 4, radius >= 80).margin_px == 0
    assert reach_of([image] * 4, radius >= 77).margin_px == 3


def test_between_two_tools_and_across_a_thin_one_nothing_is_measured():
    images, tissue = several(), tissue_from(EDGE)
    for image in images:
        image[:, EDGE + 14 : EDGE + 100] = TOOL
        image[:, : EDGE - 6] = TISSUE
    tissue[:, : EDGE - 6] = True
    tissue[:, EDGE + 14 : EDGE + 100] = False
    assert reach_of(images, tissue).num_points == 4 * 120  # at the far edge of the broad tool


def test_a_shadow_beside_a_dark_tool_is_no_tool():
    """It darkens the tissue beside three quarters of the edge, to 40 % at the tool and less up to 16 px away."""
    distance = np.arange(WIDTH_PX) - EDGE
    shade = np.where(distance >= 0, np.clip(0.4 + 0.6 * distance / 16, 0, 1), 1)[:, None]
    shaded = [image.astype(float) for image in several(tool=(40, 40, 45))]
    for image in shaded:
        image[:90] *= shade
    images = [as_u8(image) for image in shaded] * 2
    assert reach_of(images, tissue_from(EDGE)).num_points > LEAST_POINTS
    assert reach_of(images, tissue_from(EDGE)).margin_px == 0
    assert reach_of([image[:90] for image in images], tissue_from(EDGE)[:90]).num_points < LEAST_POINTS


def test_where_nothing_can_be_measured_no_margin_is_made():
    tissue = tissue_from(EDGE - 3)
    faint = np.full((*tissue.shape, 3), 100, np.uint8)
    faint[:, :EDGE] += 10  # 17 levels away
    for images, masks in (([faint] * 4, tissue), (several(), tissue | True), (several(), tissue & False)):
        reach = reach_of(images, masks)
        assert reach.num_points < LEAST_POINTS and reach.margin_px == 0 and not reach.shares.any()
    assert color_reach([], tissue).margin_px == 0


def test_what_lies_beyond_the_view_does_not_count():
    """The mask also covers a border, and its other edge there would look like a mask that is too tight."""
    images, tissue = several(), tissue_from(EDGE)
    view = np.ones_like(tissue)
    view[:, 500:] = False
    poisoned = [image.copy() for image in images]
    for image in poisoned:
        image[:, 505:] = (255, 0, 255)
    tissue[:, 508:] = False
    one, other = (reach_of(some, tissue, view) for some in (images, poisoned))
    assert one.margin_px == other.margin_px == 0 and one.num_points == other.num_points > LEAST_POINTS
    assert np.array_equal(one.shares, other.shares)
    view[:, EDGE + 10 :] = False  # now every normal leaves the view
    assert reach_of(images, tissue, view).num_points == 0


@pytest.mark.parametrize(
    ("shares", "margin"),
    [((0.5, 0.3, 0.2, 0.15), 4), ((0.5, 0.3, 0.1, 0.15), 2), ((0.1, 0.5, 0.5, 0.5), 0), ((0.0, 0.0), 0)],
)
def test_the_margin_ends_with_the_first_ring_that_has_the_color_of_tissue(shares, margin):
    assert ColorReach(np.array(shares), 1000).margin_px == margin


masks = st.integers(0, 2**31).map(
    lambda seed: cv2.GaussianBlur(np.random.default_rng(seed).random((40, 50)).astype(np.float32), (0, 0), 3) > 0.49
)


@given(masks, masks, st.integers(1, 4))
def test_only_pixels_near_a_tool_in_the_view_are_left_out(tissue, view, margin):
    left = away_from_tools(tissue, view, margin)
    assert not (left & ~tissue).any()
    assert not (away_from_tools(tissue, view, margin + 1) & ~left).any()
    tool = (~tissue & view).astype(np.uint8)
    distance = cv2.distanceTransform(1 - tool, cv2.DIST_L2, cv2.DIST_MASK_PRECISE) if tool.any() else None
    lost = tissue & ~left
    assert not lost.any() or distance[lost].max() < margin + 0.8  # a drawn disk is a little wider than a circle


def test_the_margin_is_around_tools_and_not_around_the_border_or_holes():
    tissue, view = np.ones((200, 300), bool), np.ones((200, 300), bool)
    view[:, :30] = view[:5] = False
    tissue[~view] = False  # the border
    tissue[80:120, 150:250] = False  # a tool
    tissue[40:44, 60:64] = False  # failed stereo
    assert 16 < LEAST_SHARE * view.sum()
    expected = tissue.copy()
    expected[78:122, 150:250] = expected[80:120, 148:252] = False
    left = away_from_tools(tissue, view, 2)
    corners = np.zeros_like(tissue)
    for row, column in ((78, 148), (78, 250), (120, 148), (120, 250)):
        corners[row : row + 2, column : column + 2] = True
    assert np.array_equal(left | corners, expected | corners)


CFG = tiny_config("hexplane", coarse=2, fine=6).replace({"loss.tool_margin": "measured"})


def clip(folder, level=None):
    """The sequence in a folder. With a gray `level` the ring around its tools gets it, and the masks do not say so."""
    for image in sorted((folder / "images").iterdir()) if level is not None else []:
        tool = cv2.imread(str(folder / "masks" / image.name), cv2.IMREAD_GRAYSCALE)
        rim = (cv2.dilate(tool, np.ones((3, 3), np.uint8)) > 0) & (tool == 0)
        picture = cv2.imread(str(image))
        picture[rim] = level
        cv2.imwrite(str(image), picture)
    return load_sequence(folder)


def test_no_preset_has_a_margin():
    assert {preset(name).loss.tool_margin for name in preset_names()} == {"none"}


def test_a_sequence_is_the_same_where_masks_are_exact(tiny_sequence):
    sequence = clip(tiny_sequence)
    assert with_tool_margin(sequence) == (sequence, 0)


def test_held_out_frames_are_not_measured_and_stay_held_out(tiny_sequence):
    changed, margin = with_tool_margin(clip(tiny_sequence, 140).training_view())
    assert margin == 1
    with pytest.raises(ValueError, match="held out"):
        changed.frame(1)
    part = changed.part(4, 9)
    assert np.array_equal(part.frame(0).tissue_mask, changed.frame(4).tissue_mask)


def test_training_leaves_the_pixels_out(tiny_sequence):
    sequence, said = clip(tiny_sequence, 140), []
    trainers = {
        how: start_run(sequence, CFG.replace({"loss.tool_margin": how}), say=said.append).trainer
        for how in ("none", "measured")
    }
    assert [line for line in said if "color" in line] == ["tools color 1 px around their masks, which are left out"]
    for position, index in enumerate(sequence.indices("train")):
        given, counted = (trainers[how].step_once.frames.frame(position) for how in ("none", "measured"))
        mask = sequence.frame(index).tissue_mask
        assert np.array_equal(given.tissue_mask.numpy(), mask)
        tool = (~mask).astype(np.uint8)
        near = cv2.dilate(tool, cv2.getStructuringElement(cv2.MORPH_ELLIPSE, (3, 3))) > 0
        assert np.array_equal(counted.tissue_mask.numpy(), mask & ~near)
        assert torch.equal(counted.measured, given.measured & counted.tissue_mask)
        assert counted.num_measured == counted.measured.sum()


@pytest.mark.slow
def test_their_colors_do_not_matter(make_tiny_sequence):
    """Two clips that differ in nothing else give the same Gaussians, without a prior, which looks at neighbors."""
    cfg = replace(
        CFG,
        init=replace(CFG.init, sampler="pool"),
        temporal=replace(CFG.temporal, weight=0.0),
        density=replace(CFG.density, min_densify_weight=1.0),
    )
    # Corners of the ring are farther than 1 px from the tool: a plus, not a square, is left out.
    scenes = []
    for name, level in (("one", 140), ("other", 120)):
        folder = make_tiny_sequence(name)
        before = {image.name: cv2.imread(str(image)) for image in (folder / "images").iterdir()}
        clip(folder, level)
        for image in (folder / "images").iterdir():
            tool = cv2.imread(str(folder / "masks" / image.name), cv2.IMREAD_GRAYSCALE)
            plus = cv2.dilate(tool, cv2.getStructuringElement(cv2.MORPH_ELLIPSE, (3, 3))) > 0
            cv2.imwrite(str(image), np.where(plus[..., None], cv2.imread(str(image)), before[image.name]))
        sequence = load_sequence(folder)
        assert with_tool_margin(sequence)[1] == 1
        scenes.append(train(sequence, cfg, progress=False))
    one, other = (scene.gaussians for scene in scenes)
    assert all(torch.equal(one[name], other[name]) for name in ("means", "opacity_logits", "sh_dc"))


@pytest.mark.slow
def test_a_run_records_the_margin_and_scores_use_the_masks_as_they_are(tiny_sequence, tmp_path):
    sequence, run = clip(tiny_sequence, 140), tmp_path / "run"
    scene = train(sequence, CFG, run, progress=False)
    assert json.loads((run / CONFIG).read_text())[MARGIN] == 1
    assert main(["eval", str(run), "--no-networks"]) == 0
    assert json.loads((run / "metrics.json").read_text())["protocol"][MARGIN] == 1
    plain = replace(scene, config=CFG.replace({"loss.tool_margin": "none"}))
    with_margin, without = (evaluate(one, sequence, networks=False).scores for one in (scene, plain))
    assert with_margin["psnr_tissue"] == without["psnr_tissue"]


def test_a_run_without_a_margin_says_nothing_of_it(tiny_sequence, tmp_path):
    train(clip(tiny_sequence, 140), CFG.replace({"loss.tool_margin": "none"}), tmp_path / "run", progress=False)
    assert MARGIN not in json.loads((tmp_path / "run" / CONFIG).read_text())
    assert mask_facts(tmp_path / "run") == {}


def test_windows_have_margins_of_their_own(tmp_path):
    assert mask_facts(tmp_path) == {}
    (tmp_path / CONFIG).write_text(json.dumps({"windows": [[0, 12], [10, 20]]}))
    assert mask_facts(tmp_path) == {}
    for k, margin in enumerate((2, 0)):
        (tmp_path / "windows" / f"{k:03d}").mkdir(parents=True)
        (tmp_path / "windows" / f"{k:03d}" / CONFIG).write_text(json.dumps({MARGIN: margin}))
    assert mask_facts(tmp_path) == {MARGIN: [2, 0]}


@pytest.mark.parametrize("text", ["", "[]", "{", '{"tool_margin_px": "2"}', '{"windows": 3}', '{"windows": [[0, 2]]}'])
def test_a_damaged_config_has_no_margin(tmp_path, text):
    (tmp_path / CONFIG).write_text(text)
    assert mask_facts(tmp_path) == {}
