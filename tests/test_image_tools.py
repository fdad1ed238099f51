"""Helpers for images: labels."""

import cv2
import numpy as np
import pytest

from endoprior.visualization.image_tools import label


@pytest.mark.parametrize("width", [320, 640, 1280])
def test_the_outline_of_a_label_follows_its_letters(width):
    gray = np.full((60, width, 3), 128, np.uint8)
    drawn = label(gray, "ours (default), 15 deg left")
    bright, dark = (drawn > 140).any(-1), (drawn < 110).any(-1)
    assert bright.sum() > 100 and dark.sum() > 100
    # 4 px: the outline, and the soft edge of a letter, which is not bright.
    near = cv2.dilate(bright.astype(np.uint8), np.ones((9, 9), np.uint8)) > 0
    assert not (dark & ~near).any()
    np.testing.assert_array_equal(drawn[~near], gray[~near])
    assert (gray == 128).all(), "the image itself stays as it is"
