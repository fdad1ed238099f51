"""Which value of a mask marks tools: right in both polarities, unsure where nothing speaks for either side."""

from __future__ import annotations

import numpy as np
import pytest

from endoprior.data.images import read_color, read_tool_mask
from endoprior.data.mask_files import mask_polarity

HEIGHT, WIDTH = 60, 80


def scene(tool_color=(120, 120, 125), tissue_color=(190, 90, 85), columns=20, seed=0):
    """A tool of some columns that enters from below in front of tissue, noisy: (mask, image)."""
    tool = np.zeros((HEIGHT, WIDTH), bool)
    tool[20:, 30 : 30 + columns] = True
    image = np.where(tool[..., None], tool_color, tissue_color) + np.random.default_rng(seed).normal(0, 6, (60, 80, 3))
    return tool, np.clip(image, 0, 255).astype(np.uint8)


near_lens = np.zeros((HEIGHT, WIDTH), bool)
near_lens[:, : int(0.65 * WIDTH)] = True  # a tool close to the lens


@pytest.mark.parametrize(
    ("made", "least", "most"),
    [
        (scene(), 0.95, 1),
        ((near_lens, np.where(near_lens[..., None], (110, 110, 112), (190, 90, 85)).astype(np.uint8)), 0.8, 1),
        (scene(tool_color=(150, 100, 100), tissue_color=(150, 100, 100)), 0.3, 0.95),
    ],
    ids=["gray and small", "color outweighs area", "area alone"],
)
@pytest.mark.parametrize("inverted", [False, True])
def test_the_tool_is_found_in_both_polarities(made, least, most, inverted):
    tool, image = made
    found = mask_polarity([tool ^ inverted] * 3, [image] * 3)
    assert found.tool_is_high != inverted and least < found.certainty <= most and "\n" not in found.reason


def test_ambiguous_masks_have_low_certainty():
    _, image = scene(columns=0)
    left = np.zeros((HEIGHT, WIDTH), bool)
    left[:, : WIDTH // 2] = True
    random = np.random.default_rng(1).random((HEIGHT, WIDTH)) > 0.5
    for high in (left, ~left, random):
        assert mask_polarity([high], [image]).certainty < 0.3
    for high in (np.zeros_like(left), np.ones_like(left)):
        found = mask_polarity([high], [image])
        assert found.certainty == 0 and "unknown" in found.reason
        assert found.tool_is_high != high.all()  # no tools rather than nothing but tools


def test_pixels_outside_a_round_border_are_ignored():
    tool, image = scene()
    y, x = np.mgrid[:HEIGHT, :WIDTH]
    outside = (x - 40) ** 2 + (y - 30) ** 2 > 22**2  # two thirds of all pixels, black and so as gray as the tool
    image[outside] = 0
    for high in (tool, tool | outside):
        found = mask_polarity([high], [image])
        assert found.tool_is_high and found.certainty > 0.9


def test_errors():
    tool, image = scene()
    with pytest.raises(ValueError, match="at least one mask"):
        mask_polarity([], [])
    with pytest.raises(ValueError, match="image must have shape"):
        mask_polarity([tool], [image[:-1]])


@pytest.mark.parametrize("inverted", [False, True])
def test_real_clip(real_clip, inverted):
    files = [f"{i:06d}.png" for i in (0, 30, 60)]
    highs = [read_tool_mask(real_clip / "masks" / name) ^ inverted for name in files]
    found = mask_polarity(highs, [read_color(real_clip / "images" / name) for name in files])
    assert found.tool_is_high != inverted and found.certainty > 0.9  # measured 0.97
