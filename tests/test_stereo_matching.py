"""Which camera is which, and whether the rows of a pair fit."""

import cv2
import numpy as np
import pytest

from endoprior.footage.stereo_matching import stereo_order, vertical_offset_px

WIDTH, HEIGHT = 241, 179


@pytest.fixture(scope="module")
def pair() -> tuple[np.ndarray, np.ndarray]:
    """A bulging textured wall, disparity 8 to 14 px, left and right."""
    noise = np.random.default_rng(1).standard_normal((HEIGHT, WIDTH, 3)).astype(np.float32)
    noise = cv2.GaussianBlur(noise, (0, 0), 1.5)
    right = np.clip(120 + 40 * noise / noise.std(), 0, 255).astype(np.uint8)
    x, y = np.meshgrid(np.arange(WIDTH, dtype=np.float32), np.arange(HEIGHT, dtype=np.float32))
    disparity = 8 + 6 * np.exp(-(((x - 120) / 80) ** 2) - ((y - 90) / 60) ** 2)
    left = cv2.remap(right, (x - disparity).astype(np.float32), y, cv2.INTER_CUBIC, borderMode=cv2.BORDER_REFLECT)
    return left, right


def test_swapped_cameras_are_detected(pair):
    left, right = pair
    given, exchanged = stereo_order(left, right), stereo_order(right, left)
    assert given.as_given > 0.8 and given.exchanged < 0.5 and not given.swapped
    assert exchanged.swapped
    # Not to the last bit: the matcher starts from one camera.
    assert abs(given.as_given - exchanged.exchanged) < 0.05
    for same in (left, np.zeros_like(left)):
        assert not stereo_order(same, same).swapped


@pytest.mark.parametrize("rows", [0, 1, 5])
def test_vertical_offset_is_measured(pair, rows):
    left, right = pair
    # Features are placed to about a fifth of a pixel.
    assert abs(vertical_offset_px(left, np.roll(right, rows, 0)) - rows) < 0.25


def test_too_few_features_give_no_number(pair):
    blank = np.zeros_like(pair[0])
    assert np.isnan(vertical_offset_px(blank, blank))
    assert np.isnan(vertical_offset_px(pair[0], blank))
    single = blank.copy()
    cv2.circle(single, (60, 60), 12, (255, 255, 255), -1)
    assert np.isnan(vertical_offset_px(single, single))


def test_shapes_are_checked(pair):
    for function in (stereo_order, vertical_offset_px):
        with pytest.raises(ValueError, match="right_u8"):
            function(pair[0], pair[1][:, :-2])
        with pytest.raises(ValueError, match="left_u8"):
            function(pair[0][..., 0], pair[1])
