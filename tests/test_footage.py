"""What surrounds an image, and whether the camera moves: closed forms, and no false alarms on the phantom."""

import cv2
import numpy as np
import pytest

from endoprior.footage.border import Strips, find_strips
from endoprior.footage.camera_motion import camera_motion
from endoprior.footage.round_border import Circle, find_circle


def tissue(count=6, height=120, width=160, seed=0):
    """Images of a smooth, reddish texture that slides a little."""
    rng = np.random.default_rng(seed)
    large = cv2.GaussianBlur(rng.random((height + 60, width + 60, 3), np.float32), (0, 0), 3)
    large = (large - large.min()) / np.ptp(large) * [200, 110, 100] + [40, 25, 25]
    return [large[i : i + height, 2 * i : 2 * i + width].astype(np.uint8) for i in range(count)]


def test_plain_tissue_has_no_border():
    assert not find_strips(tissue()) and find_circle(tissue()) is None
    assert not find_strips(tissue(1))


@pytest.mark.parametrize("side", ["top", "bottom", "left", "right"])
@pytest.mark.parametrize("level", [0, 70])
def test_strips_are_measured_to_the_pixel(side, level):
    images = tissue()
    for image in images:
        where = {"top": np.s_[:12], "bottom": np.s_[-12:], "left": np.s_[:, :12], "right": np.s_[:, -12:]}[side]
        image[where] = level
    assert find_strips(images) == Strips(**{name: 12 * (name == side) for name in ("top", "bottom", "left", "right")})


def test_a_strip_with_static_text_counts_and_a_static_red_one_does_not():
    images = tissue()
    for image in images:
        image[-12:], image[-9:-4, 20:60] = 60, 220
    assert find_strips(images).bottom == 12
    for image in images:
        image[-12:] = (150, 40, 40)  # a static piece of tissue is tissue
    assert not find_strips(images)


@pytest.mark.parametrize("circle", [(80, 60, 55), (80, 66, 75), (70, 50, 80), (84, 63, 58.5)])
def test_a_round_border_is_measured(circle):
    inside = Circle(*circle).mask(160, 120)
    rng = np.random.default_rng(0)
    noise = rng.integers(0, 12, (120, 160, 3), np.uint8)
    found = find_circle([np.where(inside[..., None], image, noise) for image in tissue()])
    assert np.allclose((found.center_x, found.center_y, found.radius), circle, atol=0.6)


def moved(image, shift=0.0, degrees=0.0, zoom=1.0):
    height, width = image.shape[:2]
    matrix = cv2.getRotationMatrix2D((width / 2, height / 2), degrees, zoom)
    matrix[0, 2] += shift
    return cv2.warpAffine(image, matrix, (width, height), borderMode=cv2.BORDER_REFLECT)


def test_shift_is_measured_in_pixels_of_the_images():
    base = tissue(1, 400, 640)[0]
    found = camera_motion([moved(base, 3.0 * i) for i in range(20)])
    assert np.allclose(found.pixels_per_frame, 3, atol=0.15) and np.allclose(found.path_px, 3 * np.arange(20), atol=1)
    assert found.moving and "100%" in found.reason


@pytest.mark.parametrize("how", ["degrees", "zoom"])
def test_turning_and_zooming_count(how):
    base = tissue(1, 240, 320)[0]
    values = np.linspace(0, 15, 16) if how == "degrees" else np.linspace(1, 1.4, 16)
    assert camera_motion([moved(base, **{how: v}) for v in values]).moving


def test_breathing_and_noise_are_no_camera_motion():
    base, rng = tissue(1, 240, 320)[0], np.random.default_rng(0)
    breath = [moved(base, 4 * np.sin(i / 3)) for i in range(30)]
    noisy = [np.clip(p + rng.normal(0, 3, p.shape), 0, 255).astype(np.uint8) for p in breath]
    assert not camera_motion(noisy).moving


def test_unexplained_steps_are_nan():
    found = camera_motion([tissue(1, seed=1)[0], tissue(1, seed=2)[0], np.zeros((120, 160, 3), np.uint8)])
    assert np.isnan(found.pixels_per_frame).all() and not found.moving and "0% of steps" in found.reason


def test_masked_tools_are_ignored():
    base = tissue(1, 240, 320)[0]
    images = [base.copy() for _ in range(8)]
    patch = tissue(1, 200, 200, seed=5)[0]
    for i, image in enumerate(images):
        image[20:220, 5 * i : 5 * i + 200] = patch
    tissue_masks = [np.ones((240, 320), bool) for _ in images]
    for mask in tissue_masks:
        mask[:, :240] = False
    assert camera_motion(images).moving and not camera_motion(images, tissue_masks).moving
