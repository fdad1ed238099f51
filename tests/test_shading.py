"""Depth from the light's falloff, and relative depth in millimeters."""

import cv2
import numpy as np
import pytest

from endoprior.core.checks import InputError
from endoprior.prepare import relative_depth
from endoprior.prepare.relative_depth import MAX_RATIO, NEAR_RATIO, RELIEF, RelativeScale, fit_shading

WIDTH, HEIGHT = 201, 151
COLUMN, ROW = np.meshgrid(np.linspace(-1, 1, WIDTH), np.linspace(-1, 1, HEIGHT))
BUMP = 80 - 25 * np.exp(-((COLUMN - 0.2) ** 2 + ROW**2) / 0.18)
EVERYWHERE = np.ones((HEIGHT, WIDTH), bool)


def lit(depth: np.ndarray, exposure: float = 1.0, corners: float = 0.0) -> np.ndarray:
    """(H, W, 3) image of a surface of one color that faces the light, with darker corners."""
    falloff = np.exp(-corners * (COLUMN**2 * WIDTH**2 + ROW**2 * HEIGHT**2) / (WIDTH**2 + HEIGHT**2))
    linear = 0.25 * exposure * falloff * (70 / depth) ** 2
    gray = np.clip(linear, 0, 1) ** (1 / 2.2) * 255
    return np.rint(gray[..., None] * [1.0, 0.5, 0.5]).astype(np.uint8)


def test_relief_is_scaled_by_the_constant():
    model = fit_shading([lit(BUMP)] * 3, [EVERYWHERE] * 3, working_distance_mm=60)
    depth = model.depth(lit(BUMP), EVERYWHERE)
    assert depth.shape == (HEIGHT, WIDTH) and depth.dtype == np.float32
    assert abs(np.median(depth) - 60) < 0.5
    # Not 1: half of the bump's own falloff towards the corners is taken for the lens.
    assert np.corrcoef(np.log(depth).ravel(), np.log(BUMP).ravel())[0, 1] > 0.95
    # z^-2 inverted in full, times RELIEF; smoothing flattens the peak, and vignetting takes its share of the slope.
    got, want = np.log(depth.max() / depth.min()), RELIEF * np.log(BUMP.max() / BUMP.min())
    assert 0.6 * want < got < 1.1 * want


def test_exposure_does_not_change_depth():
    model = fit_shading([lit(BUMP, e) for e in (0.8, 1.0, 1.3)], [EVERYWHERE] * 3)
    usual = model.depth(lit(BUMP), EVERYWHERE)
    for exposure in (0.6, 1.6):
        # Levels are whole numbers: the dark images have steps of 1 %, a quarter of an eighth of that in depth.
        np.testing.assert_allclose(model.depth(lit(BUMP, exposure), EVERYWHERE), usual, rtol=5e-3)


def test_a_near_object_does_not_change_the_rest():
    model = fit_shading([lit(BUMP)] * 3, [EVERYWHERE] * 3)
    lifted = np.where((COLUMN < -0.3) & (abs(ROW) < 0.8), 45.0, BUMP)
    before, after = model.depth(lit(BUMP), EVERYWHERE), model.depth(lit(lifted), EVERYWHERE)
    np.testing.assert_allclose(after[:, 150:], before[:, 150:], rtol=2e-3)
    assert (after[60:90, 20:50] < 0.9 * before[60:90, 20:50]).all()


def test_half_of_the_corner_darkening_is_vignetting():
    wall = np.full((HEIGHT, WIDTH), 70.0)
    model = fit_shading([lit(wall, corners=1.2)], [EVERYWHERE])
    assert abs(model.vignetting - 0.6) < 0.03
    depth = model.depth(lit(wall, corners=1.2), EVERYWHERE)
    # The other half, through RELIEF / 2: exp(0.125 * 0.6) = 1.08.
    assert 1.03 < depth[0, 0] / depth[75, 100] < 1.1


def test_brighter_corners_are_not_vignetting():
    assert fit_shading([lit(np.full((HEIGHT, WIDTH), 70.0), corners=-0.8)], [EVERYWHERE]).vignetting == 0


def test_tools_highlights_and_the_outside_are_filled_in():
    image = lit(BUMP)
    model = fit_shading([image], [EVERYWHERE])
    clean = model.depth(image, EVERYWHERE)
    spoiled, usable = image.copy(), EVERYWHERE.copy()
    spoiled[20:60, 20:50] = 5  # a dark tool, masked
    usable[18:62, 18:52] = False
    spoiled[100:106, 120:126] = 255  # a highlight, not masked
    depth = model.depth(spoiled, usable)
    np.testing.assert_allclose(depth, clean, rtol=0.02)
    round_border = COLUMN**2 + ROW**2 < 0.7
    assert np.isfinite(model.depth(np.where(round_border[..., None], image, 0).astype(np.uint8), round_border)).all()


def test_depth_is_finite_and_bounded_for_any_image(monkeypatch):
    monkeypatch.setattr(relative_depth, "RELIEF", 4.0)
    model = fit_shading([lit(BUMP)], [EVERYWHERE], 50)
    harsh = np.where(COLUMN[..., None] < 0, 1, 200).astype(np.uint8) * np.ones(3, np.uint8)
    depth = model.depth(harsh, EVERYWHERE)
    assert depth.min() >= 25 - 1e-3 and depth.max() <= 100 + 1e-3
    assert (model.depth(lit(BUMP), ~EVERYWHERE) == 50).all()
    assert np.isfinite(model.depth(np.zeros((HEIGHT, WIDTH, 3), np.uint8), EVERYWHERE)).all()


def test_pixels_missing_in_all_samples_use_the_image_alone():
    left, right = COLUMN < -0.1, COLUMN > 0.1
    model = fit_shading([lit(BUMP)], [left])
    depth = model.depth(lit(BUMP), right)
    assert np.isfinite(depth).all() and 0.8 < np.median(depth) / 70 < 1.25


def test_samples_without_tissue_are_an_error():
    with pytest.raises(InputError, match="got none"):
        fit_shading([lit(BUMP)], [~EVERYWHERE])


def test_relative_disparity_is_linear_in_inverse_depth():
    disparity = (3 + 0.5 * cv2.resize(1 / BUMP, (80, 60))).astype(np.float32)
    usable = np.ones(disparity.shape, bool)
    reference = RelativeScale.fit("disparity", [disparity], [usable], 60)
    depth = reference.mm(disparity)
    assert np.median(depth) == pytest.approx(60, rel=1e-3)
    assert np.percentile(depth, 2) == pytest.approx(60 / NEAR_RATIO, rel=1e-2)
    slope, shift = np.polyfit(disparity.ravel().astype(np.float64), 1 / depth.ravel().astype(np.float64), 1)
    np.testing.assert_allclose(slope * disparity + shift, 1 / depth, rtol=1e-4)
    # Scale and shift of the network do not matter, and another frame uses the same reference.
    again = RelativeScale.fit("disparity", [7 * disparity + 2], [usable], 60).mm(7 * disparity + 2)
    np.testing.assert_allclose(again, depth, rtol=1e-3)
    assert reference.mm(disparity + 0.001).mean() < depth.mean()


def test_relative_depth_keeps_its_proportions():
    relative = cv2.resize(BUMP, (80, 60)) / 1000
    reference = RelativeScale.fit("depth", [relative], [np.ones(relative.shape, bool)], 70)
    depth = reference.mm(relative)
    np.testing.assert_allclose(depth / relative, 70 / np.median(relative), rtol=1e-5)


def test_invalid_values_become_missing():
    relative = np.array([[np.nan, np.inf, 0.0, -1.0, 1.0, 1e9, 1e-9]])
    reference = RelativeScale.fit("depth", [np.array([[0.5, 1.0, 1.5, np.nan, -3.0]])], [np.ones((1, 5), bool)], 70)
    depth = reference.mm(relative)
    np.testing.assert_allclose(depth, [[0, 0, 0, 0, 70, 70 * MAX_RATIO, 70 / MAX_RATIO]], rtol=1e-6)
    reference = RelativeScale.fit("disparity", [np.linspace(-1, 1, 101)[None]], [np.ones((1, 101), bool)], 70)
    depth = reference.mm(np.array([[np.nan, -1e9, 0.0, 1e9]]))
    np.testing.assert_allclose(depth, [[0, 70 * MAX_RATIO, 70, 70 / MAX_RATIO]], rtol=1e-6, atol=1e-4)


def test_relative_samples_are_checked():
    ones = np.ones((4, 4))
    with pytest.raises(InputError, match="none"):
        RelativeScale.fit("depth", [ones], [ones < 0])
    with pytest.raises(InputError, match="vary"):
        RelativeScale.fit("disparity", [ones], [ones > 0])
