"""Ranges of carried points: what they grow with, and whether they hold the share that they say."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
import torch
from export_scenes import moving_scene

from endoprior.core.types import Camera
from endoprior.model.carry import CarriedPoints
from endoprior.model.measures import area, area_gradient, polygon_triangles, ranges_of
from endoprior.model.uncertainty import (
    ACROSS,
    CELLS,
    DRIFT,
    HIDDEN,
    NEAR,
    SEEN,
    START,
    Part,
    PointErrors,
    near_probability,
    places_of,
    point_errors,
)

RNG = np.random.default_rng(0)


def carried(positions, spread=0.0):
    positions = np.asarray(positions, np.float32)
    return CarriedPoints(positions, np.full(positions.shape[:2], float(spread)))


def errors_at(scene, positions, spread=0.0, pick=0):
    num = np.shape(positions)[1]
    return point_errors(scene, carried(positions, spread), np.full(num, pick), range(len(positions)))


def test_ranges_are_those_of_the_formulas():
    """A point straight ahead that moves 1 mm across, with carriers that disagree by 2 px of 640."""
    scene = replace(moving_scene(), depth_noise=0.01)
    camera = scene.cameras[0]
    x, y = (camera.width / 2 - camera.cx) / camera.fx * 60, (camera.height / 2 - camera.cy) / camera.fy * 60
    found = errors_at(scene, [[[x, y, 60]], [[x + 1, y, 60]]], spread=2.0)
    mm_per_px = 60 / camera.fx * camera.width / 640
    row, drift = ACROSS[SEEN], DRIFT[SEEN]
    variance_px = row.floor + row.spread * 4 + row.moved / mm_per_px**2
    assert found.across.scale[:, 0] == pytest.approx([0, np.sqrt(variance_px) * mm_per_px], rel=1e-6)
    assert found.start.scale[:, 0] == pytest.approx([np.sqrt(START.depth) * 0.6] * 2, rel=1e-6)
    along = np.sqrt(drift.depth * 0.6**2 + drift.spread * (2 * mm_per_px) ** 2)
    assert found.drift.scale[:, 0] == pytest.approx([0, along], rel=1e-6)
    assert found.confidence[0, 0] == 1
    assert found.confidence[1, 0] == pytest.approx(near_probability(variance_px, row.freedom), abs=1e-6)


def test_a_range_holds_the_share_that_it_says():
    """Of errors drawn from the distributions: along a direction, 50, 80 and 95 %."""
    total, rays = 40_000, RNG.normal(size=(1, 1, 3))
    rays /= np.linalg.norm(rays)
    scales, freedom = (0.3, 0.5, 0.2), (2.5, 4.1, 5.7)
    parts = [Part(np.full((1, 1), s), np.full((1, 1), f)) for s, f in zip(scales, freedom, strict=True)]
    errors = PointErrors(rays, *parts, np.ones((1, 1), np.float32))
    drawn = [s * RNG.standard_t(f, (total, 1)) for s, f in zip(scales[1:], freedom[1:], strict=True)]
    side = np.cross(rays[0, 0], [1, 0, 0])
    side /= np.linalg.norm(side)
    both = np.stack([side, np.cross(side, rays[0, 0])])
    error = (scales[0] * RNG.standard_t(freedom[0], (total, 2))) @ both + sum(drawn) * rays[0, 0]
    for direction in (rays[0, 0], side, (side + rays[0, 0]) / np.sqrt(2)):
        for level, tolerance in ((0.5, 0.06), (0.8, 0.05), (0.95, 0.02)):  # sums of such errors are not quite such
            half = errors.half_width(direction[None, None], level)[0, 0]
            assert (np.abs(error @ direction) <= half).mean() == pytest.approx(level, abs=tolerance)
    assert errors.half_width(2 * rays) == pytest.approx(2 * errors.half_width(rays)), "its length is a factor"
    assert errors.half_width(rays, since_pick=True) < errors.half_width(rays), "an error of the pick moves both ends"
    assert errors.along() == pytest.approx(errors.half_width(rays))


def test_what_a_tool_hides_is_less_sure():
    tissue = np.full(CELLS, 255, np.uint8)
    tissue[10:20, 10:20] = 0
    places = np.array(
        [[0.5, 0.8], [15.5 / 40, 15.5 / 32], [9.5 / 40, 15.5 / 32], [0.001, 0.5], [1.2, 0.5], [-0.1, 2.0]]
    )
    assert places_of(places, tissue).tolist() == [SEEN, HIDDEN, NEAR, NEAR, HIDDEN, HIDDEN]
    assert places_of(places, None).tolist() == [SEEN, SEEN, SEEN, NEAR, HIDDEN, HIDDEN]
    scene = moving_scene()
    points = np.tile(np.array([[0.5, 0.5, 60.0]], np.float32), (len(scene.cameras), 1, 1))
    masks = torch.full((len(scene.cameras), *CELLS), 255, dtype=torch.uint8)
    masks[5:] = 0
    found = errors_at(replace(scene, tissue=masks), points, spread=1.0)
    plain = errors_at(scene, points, spread=1.0)
    assert found.across.half_width(0.95)[1:5] == pytest.approx(plain.across.half_width(0.95)[1:5])
    assert (found.across.half_width(0.95)[5:] > plain.across.half_width(0.95)[5:]).all()
    assert (found.along()[5:] > plain.along()[5:]).all()


def test_ranges_are_counted_in_the_image():
    """The same scene at ten times the distance and ten times the size: ten times the range."""
    scene = replace(moving_scene(), depth_noise=0.01)
    points = np.array([[[0.5, 0.5, 60]], [[1.5, 0.5, 60]]])
    near, far = errors_at(scene, points, spread=1.0), errors_at(scene, 10 * points, spread=1.0)
    for one, ten in zip((near.across, near.start, near.drift), (far.across, far.start, far.drift), strict=True):
        assert ten.scale == pytest.approx(10 * one.scale, rel=1e-5)
    behind = errors_at(scene, -points, spread=1.0)
    assert np.isinf(behind.across.scale[1]).all() and (behind.confidence[1] == 0).all()


def test_confidence_is_a_probability_that_never_rises_with_the_error():
    values = near_probability(np.array([1e-4, 1, 9, 100, 1e4, np.inf]), 2.5)
    assert (np.diff(values) < 0).all() and 0.999 < values[0] < 1 and values[-1] == 0
    error = RNG.normal(size=(2, 200_000)) * np.sqrt(9 * 2.5 / RNG.chisquare(2.5, 200_000))
    assert values[2] == pytest.approx((np.hypot(*error) < 4).mean(), abs=0.01)


def test_the_area_grows_along_its_gradient():
    corners = RNG.normal(size=(1, 6, 3)) * 0.1 + np.array([[np.cos(a), np.sin(a), 60] for a in np.arange(6)])
    triangles = polygon_triangles(corners[0])
    step = 1e-6 * RNG.normal(size=corners.shape)
    expected = area(corners + step, triangles) - area(corners - step, triangles)
    assert 2 * (area_gradient(corners, triangles) * step).sum() == pytest.approx(expected[0], rel=1e-5)


def test_ranges_of_measures_hold_what_is_measured_of_moved_points():
    """Points that err by the distributions: 95 % of true distances, areas and displacements are inside."""
    total, num = 3000, 4
    corners = np.array([[0, 0, 60], [10, 0, 61], [10, 8, 60], [0, 8, 62.0]])
    true = np.broadcast_to(corners, (total, num, 3))
    rays = true / np.linalg.norm(true, axis=-1, keepdims=True)
    scales, freedom = (0.1, 0.2, 0.05), (4.0, 4.1, 5.7)
    is_later = (np.arange(total) > 0)[:, None]
    parts = [Part(np.full((total, num), s), np.full((total, num), f)) for s, f in zip(scales, freedom, strict=True)]
    parts[0], parts[2] = (part._replace(scale=part.scale * is_later) for part in (parts[0], parts[2]))
    errors = PointErrors(rays, *parts, np.ones((total, num), np.float32))
    across = parts[0].scale[..., None] * RNG.standard_t(freedom[0], (total, num, 3))
    across -= (across * rays).sum(-1, keepdims=True) * rays
    along = sum(part.scale * RNG.standard_t(f, (total, num)) for part, f in zip(parts[1:], freedom[1:], strict=True))
    # The start errs once, and the way since then in each frame.
    paths = true + across + along[..., None] * rays
    triangles = polygon_triangles(corners)
    found = ranges_of(paths, 0, triangles, errors)
    sides = np.linalg.norm(paths[:, 0] - paths[:, 1], axis=-1)
    assert (np.abs(sides - np.linalg.norm(corners[0] - corners[1])) <= found.distance)[1:].mean() > 0.93
    areas = area(paths, triangles)
    assert (np.abs(areas - area(corners[None], triangles)) <= found.area)[1:].mean() > 0.93
    assert found.displacement[0] == pytest.approx(0, abs=1e-9), "nothing has moved since the frame itself"


def test_a_camera_that_moves_sees_along_its_own_ray():
    pose = np.eye(4)
    pose[:3, 3] = 10, 0, 0
    scene = moving_scene()
    cameras = tuple(Camera(c.width, c.height, c.fx, c.fy, c.cx, c.cy, pose) for c in scene.cameras)
    found = errors_at(replace(scene, cameras=cameras), [[[0, 0, 60]], [[0, 0, 60]]])
    assert found.rays[0, 0] == pytest.approx(np.array([10, 0, 60]) / np.hypot(10, 60))
