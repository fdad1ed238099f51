"""Scores on generated images: finite or NaN by rule, never in a file; identities that the definitions imply."""

from __future__ import annotations

import json
import math
import warnings
from pathlib import Path

import numpy as np
import pytest
from frame_strategies import SEEDS, SIDES, masks, pictures
from hypothesis import given
from hypothesis import strategies as st
from hypothesis_profiles import examples

from endoprior.core.types import Camera, Frame, to_uint8
from endoprior.data.sequence import FrameSequence
from endoprior.evaluation.context import EXACT, Evaluation
from endoprior.evaluation.score import mean_over_frames
from endoprior.evaluation.scorers.depth import depth_instability, depth_rmse, depth_rmse_8bit
from endoprior.evaluation.scorers.image import psnr, psnr_tissue, ssim, ssim_tissue
from endoprior.evaluation.scorers.motion import dis_flow, flow_error
from endoprior.evaluation.scoring import evaluate
from endoprior.model.presets import preset
from endoprior.training.gaussian_trainer import GaussianTrainer

IMAGE_SCORES = (psnr, psnr_tissue, ssim, ssim_tissue)


@st.composite
def pairs(draw):
    """Two images in [0, 1] and a mask of one size."""
    height, width = draw(SIDES), draw(SIDES)
    first, second = (draw(pictures(height, width)).astype(np.float32) / np.float32(255) for _ in range(2))
    return first, second, draw(masks(height, width))


@given(pairs())
def test_scores_of_images_are_numbers_unless_nothing_is_masked(made):
    first, second, mask = made
    for score in IMAGE_SCORES:
        value = score(first, second, mask)
        assert isinstance(value, float) and math.isnan(value) == (not mask.any())
        if mask.any():
            assert value == pytest.approx(score(second, first, mask), rel=1e-9, abs=1e-9)
            equal = score(first, first, mask)
            assert equal == (math.inf if "psnr" in score.__name__ else pytest.approx(1.0, abs=1e-9))
            assert value <= equal + 1e-9
    behind = psnr_tissue(first, second, ~mask)
    assert math.isnan(behind) == mask.all()


@given(pairs())
def test_the_published_psnr_exceeds_that_of_tissue_by_its_share(made):
    first, second, mask = made
    whole, tissue = psnr(first, second, mask), psnr_tissue(first, second, mask)
    if math.isfinite(whole):
        assert whole - tissue == pytest.approx(-10 * math.log10(mask.mean()), abs=1e-6)


@given(pairs(), SEEDS)
def test_what_is_masked_out_changes_no_score(made, seed):
    first, second, mask = made
    noise = np.random.default_rng(seed).random(first.shape).astype(np.float32)
    hidden = np.where(mask[..., None], first, noise)
    for score in IMAGE_SCORES:
        assert np.array_equal(score(hidden, second, mask), score(first, second, mask), equal_nan=True)


@given(pairs())
def test_rounding_to_8_bits_is_idempotent(made):
    first, _, _ = made
    stored = to_uint8(first * 3 - 1)
    assert np.array_equal(to_uint8(stored / np.float32(255)), stored)


@pytest.mark.parametrize("value, stored", [(-3e38, 0), (-1e-9, 0), (1.001, 255), (3e38, 255)])
def test_colors_far_outside_are_clipped_without_a_warning(value, stored):
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        assert (to_uint8(np.full((2, 3, 3), value, np.float32)) == stored).all()


@given(SIDES, SIDES, SEEDS, st.sampled_from([1.0, 1e3, 1e30]))
def test_depth_errors_are_numbers_for_any_finite_depth(height, width, seed, size):
    rng = np.random.default_rng(seed)
    depth, target = (rng.random((height, width)).astype(np.float32) * np.float32(size) for _ in range(2))
    mask = rng.random((height, width)) < 0.7
    hidden = np.where(mask, depth, np.float32(np.nan))
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        rmse, wrapped = depth_rmse(hidden, target, mask), depth_rmse_8bit(hidden, target, mask, mask.size)
        unsteady = depth_instability(hidden, target, mask, mask)
    if not mask.any():
        assert math.isnan(rmse) and math.isnan(wrapped) and math.isnan(unsteady)
        return
    assert math.isfinite(rmse) and rmse >= 0 and 0 <= wrapped <= 255
    assert depth_rmse(target, target, mask) == 0 == depth_rmse_8bit(target, target, mask, mask.size)
    assert math.isnan(unsteady) or unsteady <= rmse * math.sqrt(mask.sum()) + 1e-6 * size


@given(st.lists(st.floats(allow_nan=True, allow_infinity=True), max_size=8))
def test_no_score_in_a_file_is_anything_but_a_number(values):
    result = Evaluation({})
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", RuntimeWarning)  # the sum of the largest floats
        result.add("score", mean_over_frames(values), "nothing to score")
    json.dumps([result.scores, result.skipped], allow_nan=False)
    assert ("score" in result.scores) != ("score" in result.skipped)


@examples(6)
@given(st.sampled_from([32, 33, 50]), st.integers(32, 60), SEEDS)
def test_flow_of_a_picture_compared_with_itself_has_no_error(height, width, seed):
    rng = np.random.default_rng(seed)
    images = [rng.integers(0, 256, (height, width, 3)).astype(np.uint8) for _ in range(3)]
    shown = [np.ones((height, width), bool), rng.random((height, width)) < 0.5, np.zeros((height, width), bool)]
    assert flow_error(images[:2], images[:2], shown[:2], dis_flow) == 0
    assert math.isnan(flow_error(images[1:], images[1:], shown[1:], dis_flow))


def _sequence(count, height, width, image, mask, depth=50.0):
    camera = Camera(width, height, 50.0, 50.0, width / 2, height / 2, np.eye(4))

    def read(index):
        z = np.full((height, width), depth, np.float32)
        return Frame(index, index / count, camera, image, mask, z, z > 0)

    return FrameSequence(Path("made"), [camera] * count, read)


@pytest.mark.parametrize(
    "count, height, width, level", [(2, 1, 4, 200), (2, 5, 1, 90), (3, 2, 2, 255), (2, 8, 9, 0), (10, 3, 7, 0)]
)
def test_a_scene_of_a_few_pixels_trains_and_is_scored_in_numbers(count, height, width, level, tmp_path):
    """Frames of a line or a handful of pixels, white and black ones; files without NaN; reasons that are true."""
    image, mask = np.full((height, width, 3), level, np.uint8), np.ones((height, width), bool)
    sequence = _sequence(count, height, width, image, mask)
    trainer = GaussianTrainer(sequence, preset("default"))
    trainer.start()
    for _ in range(4):
        trainer.step()
    scene = trainer.scene()
    assert all(np.isfinite(value.detach().numpy()).all() for value in scene.gaussians.tensors.values())
    found = evaluate(scene, sequence, networks=False)
    found.save(tmp_path)
    for name in ("metrics.json", "per_frame.json"):
        json.loads((tmp_path / name).read_text(), parse_constant=pytest.fail)  # called for NaN and Infinity
    if level == 0:  # black on black: no error at all, and the reason says so
        assert found.skipped["psnr"] == EXACT and "psnr" not in found.scores
    assert found.scores["ssim"] <= 1 + 1e-9
