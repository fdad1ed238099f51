"""Masked tissue: what moves with its surroundings in every frame is doubted, what moves against them is not."""

from __future__ import annotations

import cv2
import numpy as np
import pytest

from endoprior.check.masked_tissue import find_masked_tissue

HEIGHT, WIDTH, COUNT, RATE = 160, 200, 40, 25.0
STEP_PX = 1.5  # of the tissue, a frame


def wide(seed=0):
    rng = np.random.default_rng(seed)
    noise = cv2.GaussianBlur(rng.normal(0, 1, (HEIGHT, WIDTH + 100)), (0, 0), 3)
    return (120 + 45 * noise / noise.std()).clip(0, 255).astype(np.uint8)


TISSUE = np.repeat(wide()[..., None], 3, -1)


def moved(i, step=STEP_PX):
    """Tissue that goes to the left."""
    shift = np.float32([[1, 0, -step * i], [0, 1, 0]])
    return np.ascontiguousarray(cv2.warpAffine(TISSUE, shift, TISSUE.shape[1::-1])[:, :WIDTH])


def box(left, top=60, width=40, height=30):
    mask = np.zeros((HEIGHT, WIDTH), bool)
    mask[top : top + height, max(round(left), 0) : max(round(left + width), 0)] = True
    return mask


def with_tool(i, left):
    image = moved(i)
    image[box(left, top=110)] = np.repeat(wide(1)[110:140, :40, None], 3, -1).reshape(-1, 3)
    return image


def found(color, tool, count=COUNT):
    return find_masked_tissue(count, RATE, color, tool, map)


def test_a_band_that_moves_with_the_tissue_is_named_with_a_place_in_it():
    like = found(moved, lambda i: box(120 - STEP_PX * i))
    assert like is not None and box(120 - STEP_PX * like.frame)[like.y, like.x]


def test_a_tool_that_rests_before_moving_tissue_or_moves_otherwise_is_none():
    assert found(lambda i: with_tool(i, 80), lambda i: box(80, top=110)) is None
    assert found(lambda i: with_tool(i, 20 + 3 * i), lambda i: box(20 + 3 * i, top=110)) is None


def test_a_band_beside_a_tool_is_named_and_not_the_tool():
    like = found(lambda i: with_tool(i, 80), lambda i: box(120 - STEP_PX * i) | box(80, top=110))
    assert like is not None and like.y < 100


@pytest.mark.parametrize("why", ["tissue rests", "masked at times", "few frames", "too small"])
def test_nothing_is_said_where_nothing_can_be_told(why):
    step = 0.1 if why == "tissue rests" else STEP_PX
    size = {"width": 8, "height": 8} if why == "too small" else {}

    def tool(i):
        return box(120 - step * i, **size) & (why != "masked at times" or i % 10 < 7)

    assert found(lambda i: moved(i, step), tool, 9 if why == "few frames" else COUNT) is None
