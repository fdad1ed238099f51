"""Depth from two cameras: closed-form disparities, what must stay missing, and smoothing over time."""

import cv2
import numpy as np
import pytest

from endoprior.prepare import stereo
from endoprior.prepare.stereo import (
    StereoConfig,
    fill_small_holes,
    refine_disparity,
    smooth_disparity,
    stereo_depth,
    temporal_median,
)

WIDTH, HEIGHT = 161, 119  # odd on purpose
FOCAL, BASELINE = 150.0, 4.0
PRODUCT = FOCAL * BASELINE
COLUMN, ROW = np.meshgrid(np.arange(WIDTH, dtype=np.float32), np.arange(HEIGHT, dtype=np.float32))


def tissue(seed: int = 0, sigma: float = 1.2) -> np.ndarray:
    """(H, W, 3) smooth random texture around a pink."""
    noise = np.random.default_rng(seed).standard_normal((HEIGHT, WIDTH, 3)).astype(np.float32)
    noise = cv2.GaussianBlur(noise, (0, 0), sigma)
    return np.array([170, 90, 90], np.float32) + 25 * noise / noise.std()


def cameras(disparity: np.ndarray, image: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Left and right images with left(x) = right(x - disparity(x)); `image` is the right one."""
    left = cv2.remap(image, COLUMN - disparity, ROW, cv2.INTER_CUBIC, borderMode=cv2.BORDER_REFLECT)
    return tuple(np.clip(np.rint(camera), 0, 255).astype(np.uint8) for camera in (left, image))


def flat(disparity: float) -> np.ndarray:
    return np.full((HEIGHT, WIDTH), disparity, np.float32)


def measure(pair: tuple[np.ndarray, np.ndarray], **options: float):
    return stereo_depth(*pair, FOCAL, BASELINE, StereoConfig(**options))


@pytest.mark.parametrize("disparity", [6.0, 9.3, 12.5])
def test_depth_of_a_wall(disparity):
    found = measure(cameras(flat(disparity), tissue()))
    inside = np.s_[8:-8, 16:-8]
    assert (found[inside] > 0).mean() > 0.99
    # 0.05 px is half the noise that rounding to 8 bit leaves in this texture, times ten; the matcher alone has 1/16 px.
    assert np.median(np.abs(PRODUCT / found[inside] - disparity)) < 0.05
    assert found.dtype == np.float32


def test_a_slanted_plane_is_smooth_in_disparity():
    plane = 6 + 0.04 * COLUMN + 0.02 * ROW
    pair = cameras(plane, tissue())
    assert (measure(pair) == measure(pair)).all()  # the same again
    depth = measure(pair)[8:-8, 20:-8]
    error = np.abs(PRODUCT / depth[depth > 0] - plane[8:-8, 20:-8][depth > 0])
    assert (depth > 0).mean() > 0.98
    assert np.median(error) < 0.05 and np.quantile(error, 0.95) < 0.3


def test_refinement_estimates_the_remaining_shift():
    truth = 6 + 0.04 * COLUMN
    left, right = (cv2.cvtColor(camera, cv2.COLOR_RGB2GRAY) for camera in cameras(truth, tissue()))
    inside = np.s_[8:-8, 20:-8]
    for offset in (-0.3, 0.0, 0.3):
        refined, texture = refine_disparity(left, right, truth + np.float32(offset))
        assert np.abs(refined - truth)[inside].mean() < 0.02
        assert (texture > 0.5)[inside].all()
    brighter = np.clip(right * 0.9 + 35, 0, 255).astype(np.uint8)  # as cameras with different exposure see it
    refined, _ = refine_disparity(left, brighter, truth + np.float32(0.3))
    assert np.abs(refined - truth)[inside].mean() < 0.03
    far_off, _ = refine_disparity(left, right, truth + np.float32(3))
    assert np.abs(far_off - truth - 3).max() < 0.51  # never far from the matcher


def test_smoothing_removes_steps_and_keeps_edges():
    truth = 6 + 0.04 * COLUMN
    stepped = (np.rint(8 * truth) / 8).astype(np.float32)
    inside = np.s_[8:-8, 8:-8]
    assert np.abs(smooth_disparity(stepped) - truth)[inside].mean() < 0.4 * np.abs(stepped - truth)[inside].mean()
    jump = np.where(COLUMN < 80, 5, 8).astype(np.float32)
    jump[50:60, 20:30] = np.nan
    np.testing.assert_allclose(smooth_disparity(jump), jump, atol=1e-3)  # NaN where it was, and only there
    assert np.isnan(smooth_disparity(flat(np.nan))).all()


def test_pixels_outside_the_other_image_are_missing():
    depth = measure(cameras(flat(12.0), tissue()))
    assert not depth[:, :10].any()
    assert (depth[8:-8, 14:20] > 0).all()


def test_half_occluded_pixels_are_missing_and_the_edge_is_kept():
    near = (COLUMN > 80) & (COLUMN < 130)
    left, right = cameras(np.where(near, 14.0, 5.0).astype(np.float32), tissue())
    hidden = np.s_[:, 72:81]  # 14 - 5 px of the wall behind, which the right camera cannot see
    left[hidden] = tissue(seed=5)[hidden].astype(np.uint8)
    depth = measure((left, right))
    rows = np.s_[10:-10]
    assert (depth[rows, 74:79] > 0).mean() < 0.2
    both = depth[rows, 20:-8]
    between = (both > 1.2 * PRODUCT / 14) & (both < PRODUCT / 5 / 1.2)
    assert between.mean() < 0.01  # nothing is invented between the surfaces
    assert abs(np.median(depth[rows, 90:120]) - PRODUCT / 14) < 0.5
    assert abs(np.median(depth[rows, 30:60]) - PRODUCT / 5) < 2


def test_a_wall_without_texture_has_no_confidence():
    pair = tuple(np.full((HEIGHT, WIDTH, 3), 120, np.uint8) for _ in range(2))
    assert not measure(pair).any()


def test_highlights_halve_the_confidence(monkeypatch):
    monkeypatch.setattr(stereo, "MIN_CONFIDENCE", 0.55)
    monkeypatch.setattr(stereo, "FILL_PX", 0)
    image = tissue()
    plain = measure(cameras(flat(9.0), image))
    image[50:70, 70:100] = 252 + 3 * np.sign(image[50:70, 70:100, :1] - 170)
    shiny = measure(cameras(flat(9.0), image))
    assert not shiny[58:62, 90:98].any() and plain[58:62, 90:98].all()


def test_depth_stays_in_range():
    depth = measure(cameras(flat(12.0), tissue()), near_mm=60, far_mm=200)  # the wall stands at 50 mm
    assert ((depth == 0) | ((depth >= 60) & (depth <= 200))).all()


def test_swapped_images_give_little_depth():
    left, right = cameras(flat(9.0), tissue())
    assert (measure((right, left)) > 0).mean() < 0.4


def test_zero_min_confidence_still_checks_consistency(monkeypatch):
    for name in ("MIN_CONFIDENCE", "FILL_PX", "SPECKLE_PX"):
        monkeypatch.setattr(stereo, name, 0)
    left, right = cameras(flat(9.0), tissue())
    right[30:90, 60:110] = tissue(seed=7)[30:90, 60:110].astype(np.uint8)
    depth = measure((left, right))
    assert (depth[40:80, 75:105] > 0).mean() < 0.5
    kept = depth[8:-8, 16:-8]
    assert (np.abs(PRODUCT / kept[kept > 0] - 9) < 1).mean() > 0.8


def test_wide_images_are_matched_small_and_refined_at_full_size(monkeypatch):
    monkeypatch.setattr("endoprior.prepare.stereo.MATCHING_WIDTH", 60)
    depth = measure(cameras(flat(9.3), tissue(sigma=4.0)))
    inside = depth[12:-12, 24:-12]
    assert (inside > 0).mean() > 0.9
    assert abs(np.median(PRODUCT / inside[inside > 0]) - 9.3) < 0.1


def test_small_holes_are_filled_on_planes_only():
    plane = (6 + 0.05 * COLUMN).astype(np.float32)
    holed = plane.copy()
    holed[40:50, 40:50] = np.nan
    assert np.abs(fill_small_holes(holed, 100) - plane).max() < 1e-4
    assert np.isnan(fill_small_holes(holed, 99)[40:50, 40:50]).all()
    jump = np.where(COLUMN < 45, 5, 9).astype(np.float32)
    jump[40:50, 40:50] = np.nan
    assert np.isnan(fill_small_holes(jump, 100)[40:50, 40:50]).all()
    border = plane.copy()
    border[:10, 40:50] = np.nan
    assert np.isnan(fill_small_holes(border, 400)[:10, 40:50]).all()


@pytest.mark.parametrize("near_mm", [400, float("nan")])
def test_config_is_checked(near_mm):
    with pytest.raises(ValueError, match="near_mm"):
        StereoConfig(near_mm=near_mm)


def test_impossible_geometry_is_an_error():
    pair = cameras(flat(9.0), tissue())
    with pytest.raises(ValueError, match="far_mm"):
        stereo_depth(*pair, 1e5, BASELINE)


def test_temporal_median_reduces_noise_and_keeps_motion():
    rng = np.random.default_rng(0)
    still = [np.float32(80) + rng.normal(0, 0.4, (40, 50)).astype(np.float32) for _ in range(5)]
    calm = temporal_median(still)
    assert calm.std() < 0.65 * still[2].std()  # the median of 5 has 0.54 of the noise
    moving = [np.full((8, 8), 80 + 0.5 * i, np.float32) for i in range(5)]
    assert (temporal_median(moving) == moving[2]).all()
    jumps = [np.full((8, 8), z, np.float32) for z in (60, 60, 80, 80.5, 81)]
    assert (temporal_median(jumps) == 80).all()  # one side alone would pull it
    assert (temporal_median([jumps[2]]) == 80).all()


def test_temporal_median_fills_only_what_agrees():
    maps = [np.full((30, 30), 80, np.float32) for _ in range(3)]
    maps[1][10:13, 10:13] = 0
    assert (temporal_median(maps) == 80).all()
    before, hole, after = maps
    assert (temporal_median([before, hole, after * np.float32(1.1)])[10:13, 10:13] == 0).all()
    other = before * np.float32(0.5)  # a tool passes: both neighbors agree, the surroundings do not
    assert (temporal_median([other, hole, other])[10:13, 10:13] == 0).all()
    assert (temporal_median([before * 0, hole, after])[10:13, 10:13] == 0).all()
    assert not temporal_median([np.zeros((9, 9), np.float32)] * 3).any()
