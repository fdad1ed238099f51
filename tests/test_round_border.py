"""The round border: found though glare and dark tissue touch it, left out with its rim, and never imagined."""

import cv2
import numpy as np
import painted_borders
import pytest
from painted_borders import HEIGHT, NOT_ROUND, ROUND, WIDTH, finish, judge, round_image, tissue

from endoprior.footage.border import find_outline, find_strips
from endoprior.footage.round_border import Circle, find_circle, fit_circle
from endoprior.prepare.first_pass import border_notes
from endoprior.prepare.frame_geometry import make_geometry

FEW = (
    "cut above and below", "four corners", "off center, three corners", "glare, cut", "dark tissue and glare",
    "lit rim, wide", "blurred", "bars, whole", "moving border", "text", "one image",
)  # fmt: skip
NEVER = ("vignetting", "dark corners", "polygon", "round corners", "dark cavity", "labels")


@pytest.mark.parametrize("kind", FEW)
def test_the_circle_is_measured_and_nothing_beyond_it_stays(kind):
    result = judge(ROUND[kind](np.random.default_rng(1)))
    assert result["found"] and result["error"] < 0.005
    assert result["beyond"] == 0 and result["lost"] < (0.14 if kind == "lit rim, wide" else 0.07)


@pytest.mark.parametrize("kind", NEVER)
def test_other_outlines_are_no_circle(kind):
    assert not judge(NOT_ROUND[kind](np.random.default_rng(2)))["found"]


@pytest.mark.slow
@pytest.mark.parametrize(("kinds", "kind"), [(kinds, kind) for kinds in (ROUND, NOT_ROUND) for kind in kinds])
def test_every_kind(kinds, kind):
    for seed in range(3, 9):
        result = judge(kinds[kind](np.random.default_rng(seed)))
        assert result["found"] == (kinds is ROUND)
        assert result.get("error", 0) <= 0.01 and result.get("beyond", 0) <= 5


def test_an_ellipse_is_no_circle():
    painted = ROUND["whole"](np.random.default_rng(0))
    wide = np.float32([[1.2, 0, -0.2 * WIDTH / 2], [0, 1, 0]])
    assert find_circle([cv2.warpAffine(image, wide, (WIDTH, HEIGHT)) for image in painted.images]) is None


def test_a_fit_of_exact_points_is_exact():
    angles = np.array([0.1, 0.5, 1.2, 1.4])  # a quarter is enough
    points = np.array([300.0, 200.0]) + 150 * np.stack([np.cos(angles), np.sin(angles)], 1)
    assert np.allclose(fit_circle(points, np.ones(4)), [300, 200, 150])


def test_empty_images_and_noise_have_no_circle():
    for level in (0, 128, 255):
        for size in ((240, 320, 3), (16, 16, 3)):
            assert find_circle([np.full(size, level, np.uint8)] * 3) is None
    rng = np.random.default_rng(0)
    assert find_circle([rng.integers(0, 255, (120, 160, 3), np.uint8) for _ in range(4)]) is None


def test_a_wide_rim_is_measured_and_left_out():
    thin, wide = (
        find_circle(round_image(np.random.default_rng(5), painted_borders.FULL, ring=200, ring_px=px).images)
        for px in (2, 6)
    )
    assert 2 <= thin.rim_px < wide.rim_px and 6 <= wide.rim_px < 8
    frame = make_geometry(
        (WIDTH, HEIGHT), None, stereo=False, name="", field_of_view_degrees=70, max_width=0, circle=wide
    )
    kept = wide.mask(WIDTH, HEIGHT, wide.rim_px)
    assert frame.inside.sum() == kept.sum()


def test_a_border_that_moves_keeps_what_is_inside_in_every_image():
    painted = round_image(np.random.default_rng(3), painted_borders.SIDES, drift=0.02)
    found = find_circle(painted.images)
    inside = found.mask(WIDTH, HEIGHT, found.rim_px)
    assert all(circle.mask(WIDTH, HEIGHT)[inside].all() for circle in painted.circles)
    assert found.rim_px < 0.06 * found.radius


def curved_bars(rng):
    """The picture ends in curved black arcs above and below, inside of its circle."""
    y, x = np.mgrid[:HEIGHT, :WIDTH] + 0.5
    edge = ((x - WIDTH / 2) / 400) ** 2 * 200 + 18
    shows = (y > edge) & (y < HEIGHT - edge)
    painted = round_image(rng, painted_borders.SIDES)
    return [image * shows[..., None].astype(np.uint8) for image in painted.images], shows


def test_black_arcs_inside_the_circle_are_outside():
    images, shows = curved_bars(np.random.default_rng(0))
    outline = find_outline(images)
    assert (~outline.outside & ~shows).sum() < 20
    circle = outline.circle.mask(WIDTH, HEIGHT, outline.circle.rim_px)
    assert (~outline.outside & shows & circle).sum() > 0.9 * (shows & circle).sum()


def test_a_dark_shaft_is_no_black_arc():
    rng = np.random.default_rng(0)
    circle = Circle(160, 120, 110)
    images = [image * circle.mask(WIDTH, HEIGHT)[..., None] for image in tissue(rng)]
    for image in images:
        image[100:140, :150] = 0
    outline = find_outline(finish(images, rng))
    assert not outline.outside[105:135, 70:140].any()


def test_strips_are_measured_inside_the_circle():
    painted = round_image(np.random.default_rng(2), painted_borders.SIDES, bars=24)
    circle = find_circle(painted.images)
    strips = find_strips(painted.images, circle)
    assert 24 <= strips.top <= 26 and 24 <= strips.bottom <= 26 and strips.left == strips.right == 0


def test_an_uncertain_border_is_a_note_with_its_fix():
    sure, unsure = (border_notes(None, Circle(50, 40, 35, 2.0, agreement), 0.1) for agreement in (0.9, 0.5))
    assert len(sure) == 1 and "rim of 2 px" in sure[0]
    assert len(unsure) == 2 and "50% of it" in unsure[1] and "--border keep" in unsure[1]


@pytest.mark.parametrize("axes", [(0.46, 0.47), (0.4, 0.47), (0.48, 0.3)])
@pytest.mark.parametrize("seed", range(3))
def test_the_center_of_an_oval_is_not_that_of_the_circle_on_its_end(axes, seed):
    """The lens is assumed to look through the center: 50 px beside it, every path and depth is wrong."""
    seen = np.zeros((HEIGHT, WIDTH, 1), np.uint8)
    half = round(axes[0] * WIDTH), round(axes[1] * HEIGHT)
    cv2.ellipse(seen, (WIDTH // 2, HEIGHT // 2), half, 0, 0, 360, 1, -1)
    outline = find_outline([(image * seen).astype(np.uint8) for image in tissue(np.random.default_rng(seed))])
    frame = make_geometry(
        (WIDTH, HEIGHT), None, stereo=False, name="", field_of_view_degrees=70, max_width=0,
        circle=outline.circle, outside=outline.outside,
    )  # fmt: skip
    assert np.allclose(frame.matrix[:2, 2] + frame.cut[:2], (WIDTH / 2, HEIGHT / 2), atol=2)
