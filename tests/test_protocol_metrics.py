"""Metrics that only other papers' protocols use: closed forms and slow loops."""

from __future__ import annotations

import numpy as np
import pytest

from endoprior.evaluation import metrics


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
    errors = [metrics.squared_errors(*frame) for frame in frames]
    image, target, mask = (np.concatenate(parts) for parts in zip(*frames, strict=True))
    assert metrics.pooled_psnr(errors, over_frame=True) == pytest.approx(metrics.psnr(image, target, mask), abs=1e-9)
    tissue = metrics.psnr_tissue(image, target, mask)
    assert metrics.pooled_psnr(errors, over_frame=False) == pytest.approx(tissue, abs=1e-9)
    mean = metrics.mean_over_frames(metrics.psnr_tissue(*frame) for frame in frames)
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
    errors = [metrics.squared_errors(*frame) for frame in frames]
    assert metrics.pooled_psnr(errors, over_frame=False) == pytest.approx(-10 * np.log10(total / values), abs=1e-9)
    assert metrics.pooled_psnr(errors, over_frame=True) == pytest.approx(-10 * np.log10(total / 120), abs=1e-9)


def test_dividing_by_all_pixels_gains_minus_ten_log_of_the_share_of_tissue():
    frames = random_frames(2)
    errors = [metrics.squared_errors(*frame) for frame in frames]
    share = np.mean([mask.mean() for _, _, mask in frames])
    gain = metrics.pooled_psnr(errors, over_frame=True) - metrics.pooled_psnr(errors, over_frame=False)
    assert gain == pytest.approx(-10 * np.log10(share), abs=1e-9) and gain > 0


def test_pooled_scores_without_tissue_or_without_error():
    image, target, mask = random_frames(3, count=1)[0]
    nothing = metrics.squared_errors(image, target, ~np.ones_like(mask))
    assert np.isnan(metrics.pooled_psnr([nothing], over_frame=True)) and np.isnan(metrics.pooled_rmse([0.0], [0]))
    assert metrics.pooled_psnr([metrics.squared_errors(image, image, mask)], over_frame=True) == np.inf
    assert metrics.pooled_rmse([18.0, 0.0], [1, 1]) == pytest.approx(3)


@pytest.mark.parametrize("poison", [np.nan, np.inf])
def test_pooled_psnr_rejects_what_is_not_finite_on_tissue(poison):
    image, target, mask = random_frames(4, count=1)[0]
    image[np.nonzero(mask)[0][0], np.nonzero(mask)[1][0]] = poison
    with pytest.raises(ValueError, match="finite on tissue"):
        metrics.squared_errors(image, target, mask)
    with pytest.raises(ValueError, match="mask must be bool"):
        metrics.squared_errors(target, target, mask.astype(np.uint8))
    with pytest.raises(ValueError, match="shape"):
        metrics.squared_errors(target[1:], target, mask)


def loop_ssim_of_complete_windows(a: np.ndarray, b: np.ndarray) -> float:
    """SSIM by its definition, one complete window of 11 x 11 px after the other."""
    line = np.exp(-(np.arange(-5, 6) ** 2) / (2 * 1.5**2))
    weight = np.outer(line, line) / line.sum() ** 2
    values = []
    for y in range(5, a.shape[0] - 5):
        for x in range(5, a.shape[1] - 5):
            for c in range(3):
                p, q = (image[y - 5 : y + 6, x - 5 : x + 6, c].astype(np.float64) for image in (a, b))
                mean_p, mean_q = (weight * p).sum(), (weight * q).sum()
                spread = (weight * (p - mean_p) ** 2).sum() + (weight * (q - mean_q) ** 2).sum()
                both = (weight * (p - mean_p) * (q - mean_q)).sum()
                light = (2 * mean_p * mean_q + 0.01**2) / (mean_p**2 + mean_q**2 + 0.01**2)
                values.append(light * (2 * both + 0.03**2) / (spread + 0.03**2))
    return float(np.mean(values))


def test_ssim_of_complete_windows_by_a_slow_loop():
    image, target, mask = random_frames(5)[2]
    masked = [np.where(mask[..., None], values, 0) for values in (image, target)]
    expected = loop_ssim_of_complete_windows(*masked)
    assert metrics.ssim_valid(image, target, mask) == pytest.approx(expected, abs=1e-9)
    assert abs(metrics.ssim(image, target, mask) - expected) > 1e-3, "zeros around the frame change it"
    assert metrics.ssim_valid(image, image, mask) == pytest.approx(1)


def test_ssim_of_complete_windows_needs_one():
    image, target, mask = (part[:10] for part in random_frames(6)[2])
    assert np.isnan(metrics.ssim_valid(image, target, mask))
    assert np.isnan(metrics.ssim_valid(*random_frames(6)[0][:2], np.zeros((18, 14), bool)))


def test_8_bit_depth_wraps_and_is_divided_by_what_is_asked():
    target = np.full((4, 5), 60, np.float32)
    mask = np.zeros((4, 5), bool)
    mask[:2] = True
    for error, wrapped in ((2, 4), (16, 0), (20, 144), (-20, 144)):
        depth = target + np.float32(error)
        assert metrics.depth_rmse_8bit(depth, target, mask, 10) == pytest.approx(np.sqrt(wrapped))
        assert metrics.depth_rmse_8bit(depth, target, mask, 20) == pytest.approx(np.sqrt(wrapped / 2))
        assert metrics.depth_rmse_endogaussian(depth, target, mask) == pytest.approx(np.sqrt(wrapped / 2))
    assert np.isnan(metrics.depth_rmse_8bit(target, target, ~(mask | ~mask), 20))
