"""The guessed unit of depth maps: every usual unit, disparity, and ambiguous cases."""

import numpy as np
import pytest

from endoprior.footage.depth_unit import guess_unit

HEIGHT, WIDTH = 60, 80


def view(kind: str = "depth", factor: float = 1.0, tool: bool = True, shading: float = 1.0, seed: int = 0):
    """Values, validity, image and tissue mask of a wall 60-100 mm away, lit from the camera, with a tool at 40 mm."""
    rng = np.random.default_rng(seed)
    y, x = np.mgrid[:HEIGHT, :WIDTH]
    depth = 60 + 40 * (x / WIDTH) + rng.normal(0, 0.5, (HEIGHT, WIDTH))
    tissue = np.ones((HEIGHT, WIDTH), bool)
    if tool:
        tissue[20:35, 10:60] = False
        depth[~tissue] = 40
    light = 160 * (60 / depth) ** (2 * shading) + rng.normal(0, 3, depth.shape)
    image = np.repeat(light.clip(0, 255).astype(np.uint8)[..., None], 3, -1)
    values = factor * (depth if kind == "depth" else 5000 / depth)
    valid = (y > 2) | (x > 2)
    return np.where(valid, values, 0), valid, image, tissue


@pytest.mark.parametrize(
    ("factor", "unit", "mm"),
    [(1, "mm", 1), (0.001, "m", 1000), (0.1, "cm", 10), (10, "0.1 mm", 0.1), (100, "0.01 mm", 0.01)],
)
def test_usual_units(factor, unit, mm):
    guess = guess_unit([view(factor=factor)])
    assert (guess.unit, guess.mm_per_unit) == (unit, mm)
    assert guess.median == pytest.approx(80 * factor, rel=0.05)
    assert guess.reason == f"the median is {guess.median:.4g}, which in {unit} is {guess.median * mm:.0f} mm away"


@pytest.mark.parametrize(
    ("median", "unit"), [(19.9, "cm"), (20, "mm"), (249, "mm"), (250, "0.1 mm"), (1.0, "ambiguous")]
)
def test_limits_between_units(median, unit):
    flat = np.full((HEIGHT, WIDTH), median), np.ones((HEIGHT, WIDTH), bool)
    image = np.full((HEIGHT, WIDTH, 3), 100, np.uint8)
    assert guess_unit([(*flat, image, flat[1])]).unit == unit


@pytest.mark.parametrize("tool", [True, False])
def test_disparity_is_not_depth(tool):
    guess = guess_unit([view("disparity", tool=tool)])
    assert (guess.unit, guess.mm_per_unit) == ("disparity", None)
    assert guess.shading > 0.5 and "larger values are nearer" in guess.reason
    assert np.isnan(guess.tool_ratio) != tool


def test_a_near_tool_decides_without_shading_and_where_tissue_is_brighter_far_away():
    assert guess_unit([view("disparity", shading=0)]).unit == "disparity"
    assert guess_unit([view("depth", shading=0)]).unit == "mm"
    guess = guess_unit([view("depth", shading=-1)])
    assert guess.shading > 0.5 and guess.tool_ratio < 0.7 and guess.unit == "mm"


def test_no_depth_and_constant_depth():
    values, _, image, tissue = view()
    none = guess_unit([(values, np.zeros_like(tissue), image, tissue)])
    assert (none.unit, none.mm_per_unit, none.reason) == ("none", None, "no pixel has depth")
    assert guess_unit([(np.full_like(values, 70), tissue | True, image, tissue)]).shading == 0
    values, valid, image, tissue = view()  # without tissue all pixels count
    assert guess_unit([(values, valid, image, np.zeros_like(tissue))]).unit == "mm"


def test_the_real_clip_is_in_mm_and_its_inverse_is_disparity(real_clip):
    from endoprior.data import load_sequence

    sequence = load_sequence(real_clip)
    frames = [sequence.frame(i) for i in (0, 45, 89)]
    assert guess_unit([(f.depth, f.depth_valid, f.rgb_u8, f.tissue_mask) for f in frames]).unit == "mm"
    inverse = [(2463 / np.maximum(f.depth, 1), f.depth_valid, f.rgb_u8, f.tissue_mask) for f in frames]
    assert guess_unit(inverse).unit == "disparity"
