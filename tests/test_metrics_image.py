"""Image and depth scores against closed forms and a literal SSIM loop."""

from __future__ import annotations

import numpy as np
import pytest

from endoprior.evaluation.metrics import (
    depth_rmse,
    depth_rmse_endogaussian,
    mean_over_frames,
    psnr,
    psnr_behind_tool,
    psnr_tissue,
    ssim,
    ssim_tissue,
    to_uint8,
)

ALL = np.ones((16, 14), bool)
NONE = ~ALL


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


@pytest.mark.parametrize("score", [psnr, psnr_tissue])
def test_psnr_of_equal_images_is_infinite(score):
    assert score(random_image(0), random_image(0), ALL) == np.inf


def test_psnr_ignores_what_is_outside_the_mask():
    mask = half_mask()
    image, target = random_image(0), random_image(1)
    changed = np.where(mask[..., None], image, 1 - image)
    for score in (psnr, psnr_tissue, ssim):
        assert score(changed, target, mask) == score(image, target, mask)


def test_published_psnr_exceeds_the_tissue_one_by_the_masked_fraction():
    mask = half_mask()
    got = psnr(random_image(0), random_image(1), mask) - psnr_tissue(random_image(0), random_image(1), mask)
    assert got == pytest.approx(-10 * np.log10(0.75), abs=1e-9)  # float64 rounding only
    assert got > 0


def test_psnr_behind_tool_scores_the_tool_pixels_alone():
    mask, truth = half_mask(), np.full((16, 14, 3), 0.5)
    image = np.where(mask[..., None], np.zeros(3), np.full(3, 0.6))
    assert psnr_behind_tool(image, truth, mask) == pytest.approx(20, abs=1e-9)  # -10 log10(0.1^2), float64


def loop_ssim(a: np.ndarray, b: np.ndarray) -> float:
    """SSIM by its definition: one window at a time, one pixel at a time, zeros outside the frame."""
    height, width, channels = a.shape
    weight = {(i, j): np.exp(-(i * i + j * j) / (2 * 1.5**2)) for i in range(-5, 6) for j in range(-5, 6)}
    norm = sum(weight.values())
    total = 0.0
    for c in range(channels):
        for y in range(height):
            for x in range(width):
                ma = mb = aa = bb = ab = 0.0
                for (i, j), w in weight.items():
                    if 0 <= y + i < height and 0 <= x + j < width:
                        p, q = float(a[y + i, x + j, c]), float(b[y + i, x + j, c])
                        w = w / norm
                        ma, mb, aa, bb, ab = ma + w * p, mb + w * q, aa + w * p * p, bb + w * q * q, ab + w * p * q
                luminance = (2 * ma * mb + 1e-4) / (ma**2 + mb**2 + 1e-4)
                structure = (2 * (ab - ma * mb) + 9e-4) / (aa - ma**2 + bb - mb**2 + 9e-4)
                total += luminance * structure
    return total / (height * width * channels)


def test_ssim_equals_its_literal_loop():
    mask, a, b = half_mask(), random_image(0), random_image(1)
    want = loop_ssim(a * mask[..., None], b * mask[..., None])
    assert ssim(a, b, mask) == pytest.approx(want, abs=1e-12)  # both in float64, other order of summation


def test_ssim_of_equal_images_is_one():
    assert ssim(random_image(0), random_image(0), ALL) == pytest.approx(1, abs=1e-12)  # float64 rounding


def test_ssim_does_not_tell_image_from_target():
    assert ssim(random_image(0), random_image(1), ALL) == ssim(random_image(1), random_image(0), ALL)


def test_ssim_works_on_a_single_pixel():
    one = np.full((1, 1, 3), 0.5)
    assert ssim(one, one, np.ones((1, 1), bool)) == pytest.approx(1, abs=1e-12)  # float64 rounding


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


@pytest.mark.parametrize(("error_mm", "square"), [(2, 4), (16, 0), (20, 144)])
@pytest.mark.parametrize("sign", [-1, 1])
def test_endogaussian_depth_wraps_modulo_256(error_mm, square, sign):
    target = np.full((16, 14), 60.4)  # truncated to 60
    got = depth_rmse_endogaussian(target + sign * error_mm, target, ALL)
    assert got == pytest.approx(np.sqrt(square))
    # Three quarters of the frame count, but the sum is still divided by all of it.
    assert depth_rmse_endogaussian(target + sign * error_mm, target, half_mask()) == pytest.approx(
        np.sqrt(square * 0.75)
    )


def test_endogaussian_depth_above_8_bits_wraps_too():
    assert depth_rmse_endogaussian(np.full((16, 14), 258.9), np.full((16, 14), 0.9), ALL) == 2


def test_an_empty_mask_scores_nan():
    for score in (psnr, psnr_tissue, ssim):
        assert np.isnan(score(random_image(0), random_image(1), NONE))
    assert np.isnan(psnr_behind_tool(random_image(0), random_image(1), ALL))
    for score in (depth_rmse, depth_rmse_endogaussian):
        assert np.isnan(score(np.ones((16, 14)), np.ones((16, 14)), NONE))


@pytest.mark.parametrize("score", [psnr, psnr_tissue, psnr_behind_tool, ssim])
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


@pytest.mark.parametrize("score", [depth_rmse, depth_rmse_endogaussian])
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
