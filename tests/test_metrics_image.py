"""Image and depth scores, of other papers' protocols too, against closed forms and slow loops."""

from __future__ import annotations

import subprocess
import sys

import numpy as np
import pytest

from endoprior.core.types import to_uint8
from endoprior.evaluation.score import mean_over_frames
from endoprior.evaluation.scorers.depth import depth_instability, depth_rmse, depth_rmse_8bit
from endoprior.evaluation.scorers.image import (
    pooled_psnr,
    psnr,
    psnr_tissue,
    squared_errors,
    ssim,
    ssim_tissue,
    ssim_valid,
)

ALL = np.ones((16, 14), bool)


def random_image(seed: int) -> np.ndarray:
    """(16, 14, 3) float32 in [0, 1]."""
    return np.random.default_rng(seed).random((16, 14, 3), dtype=np.float32)


def half_mask() -> np.ndarray:
    """(16, 14) with 3/4 of the rows True."""
    mask = ALL.copy()
    mask[:4] = False
    return mask


@pytest.mark.parametrize("score", [psnr, psnr_tissue])
def test_psnr_of_a_constant_offset(score):
    target = np.full((16, 14, 3), 0.25)
    assert score(target + 0.1, target, ALL) == pytest.approx(20, abs=1e-9)  # -10 log10(0.1^2), float64


def loop_ssim(a: np.ndarray, b: np.ndarray, border: int) -> float:
    """SSIM by its definition, window by window, without a border of windows; zeros outside the frame."""
    line = np.exp(-(np.arange(-5, 6) ** 2) / (2 * 1.5**2))
    weight = np.outer(line, line) / line.sum() ** 2
    a, b = (np.pad(image.astype(np.float64), ((5, 5), (5, 5), (0, 0))) for image in (a, b))
    values = []
    for y in range(border, a.shape[0] - 10 - border):
        for x in range(border, a.shape[1] - 10 - border):
            for c in range(3):
                p, q = (image[y : y + 11, x : x + 11, c] for image in (a, b))
                mean_p, mean_q = (weight * p).sum(), (weight * q).sum()
                spread = (weight * (p - mean_p) ** 2).sum() + (weight * (q - mean_q) ** 2).sum()
                both = (weight * (p - mean_p) * (q - mean_q)).sum()
                light = (2 * mean_p * mean_q + 0.01**2) / (mean_p**2 + mean_q**2 + 0.01**2)
                values.append(light * (2 * both + 0.03**2) / (spread + 0.03**2))
    return float(np.mean(values))


@pytest.mark.parametrize(("score", "border"), [(ssim, 0), (ssim_valid, 5)])
def test_ssim_equals_its_literal_loop(score, border):
    mask, a, b = half_mask(), random_image(0), random_image(1)
    want = loop_ssim(a * mask[..., None], b * mask[..., None], border)
    assert score(a, b, mask) == pytest.approx(want, abs=1e-12)  # both in float64, other order of summation
    assert score(a, a, mask) == pytest.approx(1)


def test_rounding_keeps_every_8_bit_level_and_rounds_to_the_nearest():
    levels = np.arange(256, dtype=np.uint8)
    as_float = np.repeat(levels[:, None, None].astype(np.float32) / np.float32(255), 3, -1)
    assert np.array_equal(to_uint8(as_float)[:, 0, 0], levels)
    image = np.array([[[0.49 / 255, 0.51 / 255, 254.6 / 255], [-3, 7, 0.5 / 255]]])
    assert to_uint8(image).tolist() == [[[0, 1, 255], [0, 255, 1]]]


def test_depth_rmse_of_a_constant_offset():
    target = np.linspace(40, 90, 16 * 14, dtype=np.float32).reshape(16, 14)
    assert depth_rmse(target + np.float32(3), target, ALL) == pytest.approx(3, abs=1e-5)  # float32 inputs near 100


def test_depth_rmse_scores_valid_pixels_alone_and_counts_holes():
    depth, target, valid = np.zeros((2, 2)), np.full((2, 2), 50.0), np.array([[True, False], [True, False]])
    depth[:, 1] = np.nan  # not valid: may be anything
    depth[0, 0] = 50
    assert depth_rmse(depth, target, valid) == pytest.approx(np.sqrt(50**2 / 2))


@pytest.mark.parametrize(("error_mm", "square"), [(2, 4), (16, 0), (20, 144), (-20, 144), (198.5, 36)])
def test_8_bit_depth_wraps_and_is_divided_by_what_is_asked(error_mm, square):
    target, mask = np.full((16, 14), 60.4), half_mask()  # truncated to 60
    for pixels in (mask.size, int(mask.sum())):
        got = depth_rmse_8bit(target + error_mm, target, mask, pixels)
        assert got == pytest.approx(np.sqrt(square * mask.sum() / pixels))
    assert np.isnan(depth_rmse_8bit(target, target, ~ALL, 20))


@pytest.mark.parametrize("score", [psnr, psnr_tissue, ssim])
def test_bad_images_are_named(score):
    good = random_image(0)
    poisoned = good.copy()
    poisoned[3, 3, 1] = np.nan
    with pytest.raises(ValueError, match="image must be finite"):
        score(poisoned, good, half_mask())
    with pytest.raises(ValueError, match="target must be finite"):
        score(good, poisoned, half_mask())
    with pytest.raises(ValueError, match="image must be floating point; got uint8"):
        score(to_uint8(good), good, half_mask())
    with pytest.raises(ValueError, match="mask must be bool"):
        score(good, good, half_mask().astype(np.uint8))
    with pytest.raises(ValueError, match="target must have shape"):
        score(good, good[:-1], half_mask())


@pytest.mark.parametrize("score", [depth_rmse, lambda *arrays: depth_rmse_8bit(*arrays, ALL.size)])
def test_a_nan_among_valid_depths_is_an_error_and_not_a_lost_pixel(score):
    depth, target = np.ones((16, 14)), np.ones((16, 14))
    depth[5, 5] = np.nan
    with pytest.raises(ValueError, match="depth at valid pixels must be finite; got 1 values"):
        score(depth, target, ALL)
    with pytest.raises(ValueError, match="target at valid pixels must be finite"):
        score(target, depth, ALL)
    with pytest.raises(ValueError, match="valid must have shape"):
        score(depth, target, ALL[:-1])


def test_mean_over_frames_leaves_out_what_has_no_value():
    assert mean_over_frames([1.0, np.nan, 3.0, np.inf]) == 2.0
    assert np.isnan(mean_over_frames([np.nan]))
    assert np.isnan(mean_over_frames([]))


def test_ssim_of_tissue_leaves_the_masked_part_out():
    """Black in both images scores 1; the tissue alone scores what is left of the mean."""
    rng = np.random.default_rng(3)
    image, target = rng.random((2, 40, 60, 3)).astype(np.float32)
    mask = np.zeros((40, 60), bool)
    mask[:, :30] = True
    whole = np.ones_like(mask)
    assert ssim_tissue(image, target, whole) == pytest.approx(ssim(image, target, whole))
    assert ssim_tissue(image, target, mask) < ssim(image, target, mask)
    assert ssim_tissue(image, image, mask) == pytest.approx(1)
    assert np.isnan(ssim_tissue(image, target, np.zeros_like(mask)))


def random_frames(seed: int, count: int = 3, height: int = 18, width: int = 14):
    """Triples of a rendered frame, a true one and a tissue mask, float32 in [0, 1]."""
    rng = np.random.default_rng(seed)
    shape = (height, width, 3)
    return [
        (
            rng.random(shape, dtype=np.float32),
            rng.random(shape, dtype=np.float32),
            rng.random(shape[:2]) < 0.2 + 0.3 * k,
        )
        for k in range(count)
    ]


def test_pooled_psnr_is_that_of_one_long_frame():
    frames = random_frames(0)
    errors = [squared_errors(*frame) for frame in frames]
    image, target, mask = (np.concatenate(parts) for parts in zip(*frames, strict=True))
    assert pooled_psnr(errors, over_frame=True) == pytest.approx(psnr(image, target, mask), abs=1e-9)
    tissue = psnr_tissue(image, target, mask)
    assert pooled_psnr(errors, over_frame=False) == pytest.approx(tissue, abs=1e-9)
    mean = mean_over_frames(psnr_tissue(*frame) for frame in frames)
    assert abs(tissue - mean) > 0.01, "pooling and the mean of frames are two numbers"


def test_pooled_psnr_by_a_slow_loop():
    frames = random_frames(1, count=2, height=5, width=4)
    total, values = 0.0, 0
    for image, target, mask in frames:
        for y in range(5):
            for x in range(4):
                for c in range(3):
                    if mask[y, x]:
                        total += (float(image[y, x, c]) - float(target[y, x, c])) ** 2
                        values += 1
    errors = [squared_errors(*frame) for frame in frames]
    assert pooled_psnr(errors, over_frame=False) == pytest.approx(-10 * np.log10(total / values), abs=1e-9)
    assert pooled_psnr(errors, over_frame=True) == pytest.approx(-10 * np.log10(total / 120), abs=1e-9)


def test_ssim_of_complete_windows_needs_one():
    image, target, mask = (part[:10] for part in random_frames(6)[2])
    assert np.isnan(ssim_valid(image, target, mask))
    assert np.isnan(ssim_valid(*random_frames(6)[0][:2], np.zeros((18, 14), bool)))


# --- depth from frame to frame

WHOLE = np.ones((6, 8), bool)


def test_instability_of_a_surface_that_moves_as_one():
    depth = np.linspace(40, 90, 48).reshape(6, 8)
    assert depth_instability(depth, depth - 1.5, WHOLE, WHOLE) == pytest.approx(1.5)
    assert depth_instability(depth, depth, WHOLE, WHOLE) == 0


def test_instability_counts_pixels_that_are_tissue_and_drawn_in_both_frames():
    depth_a, depth_b = np.full((1, 5), 10.0), np.full((1, 5), 12.0)
    mask_a, mask_b = np.ones((1, 5), bool), np.ones((1, 5), bool)
    depth_a[0, 0], depth_b[0, 1] = 0, 0  # not rendered in one of them
    mask_a[0, 2] = mask_b[0, 3] = False
    depth_b[0, 2] = depth_a[0, 3] = np.nan  # outside the masks: may be anything
    depth_b[0, 4] = 17
    assert depth_instability(depth_a, depth_b, mask_a, mask_b) == 7


def test_instability_without_a_common_pixel_is_nan():
    assert np.isnan(depth_instability(np.ones((6, 8)), np.ones((6, 8)), WHOLE, ~WHOLE))
    assert np.isnan(depth_instability(np.zeros((6, 8)), np.ones((6, 8)), WHOLE, WHOLE))


def test_instability_names_bad_input():
    depth = np.ones((6, 8))
    with pytest.raises(ValueError, match="depth at valid pixels must be finite"):
        depth_instability(depth, np.full((6, 8), np.nan), WHOLE, WHOLE)
    with pytest.raises(ValueError, match="must be bool"):
        depth_instability(depth, depth, WHOLE, WHOLE.astype(int))
    with pytest.raises(ValueError, match="must have shape"):
        depth_instability(depth, depth[1:], WHOLE, WHOLE)


def test_metrics_import_without_torch():
    module = "endoprior.evaluation.scorers.depth"
    code = f"import sys, {module}; print('torch' in sys.modules, 'torchvision' in sys.modules)"
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    assert done.stdout.split() == ["False", "False"]
