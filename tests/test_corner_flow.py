"""Corners followed to the next image and back: closed forms of shifted images, and corners that are lost."""

import cv2
import numpy as np
import pytest

from endoprior.footage.keypoints import track_points

HEIGHT, WIDTH, MARGIN = 90, 120, 30


def shifted(dx: float, dy: float) -> np.ndarray:
    """(H, W) a smooth texture whose content lies (dx, dy) px farther right and down."""
    noise = np.random.default_rng(0).random((HEIGHT + 2 * MARGIN, WIDTH + 2 * MARGIN)).astype(np.float32)
    texture = cv2.GaussianBlur(noise, (0, 0), 2)
    moved = cv2.warpAffine(texture, np.float32([[1, 0, dx], [0, 1, dy]]), texture.shape[::-1], flags=cv2.INTER_CUBIC)
    cut = moved[MARGIN:-MARGIN, MARGIN:-MARGIN]
    return np.rint(255 * (cut - texture.min()) / np.ptp(texture)).clip(0, 255).astype(np.uint8)


GRID = np.stack(np.meshgrid(np.arange(30.0, 90, 10), np.arange(30.0, 60, 10)), -1).reshape(-1, 2).astype(np.float32)


@pytest.mark.parametrize("shift", [(0, 0), (3, -2), (5.5, 4.25)])
def test_a_shift_is_followed(shift):
    there, kept = track_points(shifted(0, 0), shifted(*shift), GRID)
    assert kept.all() and there.shape == GRID.shape and there.dtype == np.float32
    assert np.abs(there - GRID - np.float32(shift)).max() < 0.1  # gray levels are whole numbers


def test_what_the_other_image_does_not_show_is_lost():
    first, second = shifted(0, 0), shifted(3, 0)
    second[:, 60:] = np.random.default_rng(1).integers(0, 255, second[:, 60:].shape)
    _, kept = track_points(first, second, GRID, max_error_px=0.7)
    assert kept[GRID[:, 0] < 40].all() and not kept[GRID[:, 0] > 75].any()
    _, kept = track_points(first, shifted(3, 0), GRID, max_error_px=0.0)
    assert not kept.any(), "nothing is nearer than 0"
    _, kept = track_points(first, shifted(3, 0), np.float32([[-50, 10], [500, 20]]))
    assert not kept.any()


def test_a_guess_finds_what_is_too_far_without_one():
    first, second, far = shifted(0, 0), shifted(24, 0), np.float32([24, 0])
    small = {"side_px": 9, "halvings": 0}
    _, kept = track_points(first, second, GRID, **small)
    guess = GRID + far + np.float32(0.8)
    before = guess.copy()
    there, found = track_points(first, second, GRID, guess=guess, **small)
    assert kept.mean() < 0.5 and found.all() and np.abs(there - GRID - far).max() < 0.1
    assert (guess == before).all()
    loose = (cv2.TERM_CRITERIA_COUNT, 0, 0.0)
    there, _ = track_points(first, second, GRID, guess=guess, criteria=loose, **small)
    assert np.abs(there - GRID - far).max() > 0.1, "no step but those that the criteria allow"
