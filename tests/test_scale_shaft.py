"""The distance of instruments from the edges of their shafts: closed form, masks by ray casting, the frontier."""

from __future__ import annotations

import numpy as np
import pytest

from endoprior.prepare.shaft import TipReading, axis_of, frontier, ray_at, tip_readings
from endoprior.prepare.shaft_edges import line_through, shafts_of

HEIGHT, WIDTH, RADIUS = 256, 320, 4.0
MATRIX = np.array([[290.0, 0, 160.0], [0, 290.0, 128.0], [0, 0, 1]])
NOTHING = np.zeros((HEIGHT, WIDTH), bool)


def cylinder_mask(tip, direction, radius=RADIUS, matrix=MATRIX):
    """(H, W) True where the ray of a pixel's center hits a cylinder that ends flat at `tip` (3,), mm, and runs on
    forever against `direction` (3,).
    """
    direction = np.array(direction, float) / np.linalg.norm(direction)
    x, y = np.meshgrid(np.arange(WIDTH) + 0.5, np.arange(HEIGHT) + 0.5)
    rays = np.stack([(x - matrix[0, 2]) / matrix[0, 0], (y - matrix[1, 2]) / matrix[1, 1], np.ones_like(x)], -1)
    across, start = rays - (rays @ direction)[..., None] * direction, tip - (tip @ direction) * direction
    a, b, c = (across**2).sum(-1), across @ start, start @ start - radius**2
    root = np.sqrt(np.maximum(b**2 - a * c, 0))
    depth = (b - root) / a
    along = (depth[..., None] * rays - tip) @ direction
    facing = rays @ direction
    cap = (tip @ direction) / np.where(np.abs(facing) > 1e-9, facing, 1e-9)
    on_cap = np.linalg.norm(cap[..., None] * rays - tip, axis=-1) < radius
    return ((b**2 > a * c) & (depth > 0) & (along < 0)) | (on_cap & (cap > 0))


POSES = {
    "flat": ((10.0, 5.0, 80.0), (1.0, -0.2, 0.0)),
    "into the scene": ((5.0, 0.0, 95.0), (0.6, -0.5, 0.6)),
    "steep": ((0.0, 2.0, 110.0), (0.45, -0.3, 0.8)),
    "towards the camera": ((20.0, -5.0, 60.0), (0.9, -0.3, -0.15)),
    "from below": ((-5.0, 5.0, 70.0), (0.2, -1.0, 0.3)),
}


@pytest.mark.parametrize("pose", POSES)
def test_the_axis_of_a_cylinder_in_closed_form(pose):
    tip, direction = (np.array(each) for each in POSES[pose])
    direction = direction / np.linalg.norm(direction)
    foot = tip - (tip @ direction) * direction
    distance = np.linalg.norm(foot)
    # Planes through the camera center that touch the cylinder: their normals are at 90 degrees - a to the way there.
    sine = RADIUS / distance
    beside = np.cross(direction, foot / distance)
    normals = [sine * foot / distance + sign * np.sqrt(1 - sine**2) * beside for sign in (1, -1)]
    lines = np.stack([np.linalg.solve(MATRIX.T, normal) for normal in normals])
    seen = MATRIX @ (tip - 5 * direction)
    axis = axis_of(
        lines * np.array([[2.0], [-0.1]]), seen[:2] / seen[2], MATRIX, RADIUS
    )  # a line has no sign or length
    assert axis.foot_mm == pytest.approx(foot, abs=1e-9) and abs(axis.direction @ direction) == pytest.approx(1)
    assert axis.distance_mm == pytest.approx(distance)
    image = MATRIX @ tip
    assert axis.nearest_to(ray_at(image[:2] / image[2], MATRIX)) == pytest.approx(tip, abs=1e-8)
    assert np.isnan(axis.nearest_to(direction)).all()
    assert axis_of(np.stack([lines[0]] * 2), seen[:2] / seen[2], MATRIX, RADIUS) is None, "one line twice"


@pytest.mark.parametrize("pose", POSES)
def test_the_distance_of_a_rendered_shaft_is_found_within_one_percent(pose):
    tip, direction = (np.array(each) for each in POSES[pose])
    edges = list(shafts_of(cylinder_mask(tip, direction), NOTHING))
    assert len(edges) == 1
    lines = np.stack([line_through(each) for each in edges[0].ends])
    axis = axis_of(lines, edges[0].inside, MATRIX, RADIUS)
    direction = direction / np.linalg.norm(direction)
    true = np.linalg.norm(tip - (tip @ direction) * direction)
    # Where the shaft is seen, not at its foot point, which may be far outside of the image.
    ray = ray_at(edges[0].inside, MATRIX)
    start = tip - (tip @ direction) * direction
    unit = ray / np.linalg.norm(ray)
    along = (start @ unit) * (direction @ unit) / (1 - (direction @ unit) ** 2)
    assert axis.nearest_to(ray)[2] == pytest.approx((start + along * direction)[2], rel=0.01), true
    end = MATRIX @ tip
    assert np.linalg.norm(edges[0].tip - end[:2] / end[2]) < 1.2 * edges[0].width / 2 + 3


def test_a_round_border_and_tools_that_are_no_shafts():
    tip, direction = np.array((5.0, 0.0, 95.0)), np.array((0.6, -0.5, 0.6))
    x, y = np.meshgrid(np.arange(WIDTH) - 160, np.arange(HEIGHT) - 128)
    outside = x**2 + y**2 > 125**2
    tools = cylinder_mask(tip, direction) | outside
    assert len(list(shafts_of(tools, outside))) == 1
    assert not list(shafts_of(outside, outside)) and not list(shafts_of(NOTHING, NOTHING))
    blob = x**2 + (y - 100) ** 2 < 60**2  # enters from the border, and is not straight
    assert not list(shafts_of(blob, NOTHING))
    stub = (y > 70) & (np.abs(x) < 40)  # straight, and too short for its width
    assert not list(shafts_of(stub, NOTHING))
    inner = (np.abs(x) < 80) & (np.abs(y) < 10)  # straight, and does not enter
    assert not list(shafts_of(inner, NOTHING))


def test_a_tip_on_tissue_gives_the_scale_of_its_depth():
    tip, direction = np.array((10.0, 5.0, 80.0)), np.array((1.0, -0.2, 0.0))
    tools = cylinder_mask(tip, direction)
    image = np.full((HEIGHT, WIDTH, 3), (180, 70, 60), np.uint8)
    image[tools] = (70, 75, 70)
    depth = np.full((HEIGHT, WIDTH), 50, np.float32)
    (reading,) = tip_readings(3, tools, NOTHING, image, depth, MATRIX, RADIUS)
    assert reading.frame == 3 and np.exp(reading.log_ratio) == pytest.approx(80 / 50, rel=0.03)
    assert 0.005 < reading.std < 0.2
    (half,) = tip_readings(3, tools, NOTHING, image, depth, MATRIX, RADIUS / 2)
    assert half.log_ratio == pytest.approx(reading.log_ratio - np.log(2), abs=0.01)  # all lengths are half
    assert tip_readings(3, tools, NOTHING, image, 0 * depth, MATRIX, RADIUS) == []


def made(gaps, noise, seed=0, scale=1.5):
    """Readings with known gaps between tip and tissue, at places of their own."""
    rng = np.random.default_rng(seed)
    return [
        TipReading(i, (30.0 * (i % 10), 30.0 * (i // 10)), float(np.log(scale) - gap + rng.normal(0, noise)), noise)
        for i, gap in enumerate(gaps)
    ]


@pytest.mark.parametrize(("contact", "noise"), [(1.0, 0.03), (0.4, 0.03), (0.4, 0.1), (0.2, 0.05)])
def test_the_frontier_is_where_tips_touch_tissue(contact, noise):
    rng = np.random.default_rng(1)
    gaps = np.where(rng.random(60) < contact, 0, rng.exponential(0.25, 60))
    readings = made(gaps, noise)
    log_scale, error = frontier(readings, 640)
    ratios = np.array([each.log_ratio for each in readings])
    assert abs(log_scale - np.log(1.5)) < min(0.07, 2 * error) and 0.05 < error < 0.2
    if contact < 1:
        assert np.median(ratios) < np.log(1.5) - 0.04 and np.median(ratios) < log_scale, "the median is too small"
    assert noise < 0.1 or ratios.max() > np.log(1.5) + 0.1, "the largest is too large"


def test_a_tool_at_rest_counts_once_and_one_wrong_shaft_does_not_decide():
    readings = made(np.zeros(20), 0.03)
    wrong = [TipReading(i, (600.0, 500.0), float(np.log(4.0)), 0.03) for i in range(20, 80)]
    log_scale, error = frontier([*readings, *wrong], 640)
    assert np.exp(log_scale) == pytest.approx(1.5, rel=0.08)
    assert frontier(readings[:1], 640)[1] > error
