"""Carried points: where they go, how sure that is, and which frames show them."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
import torch
from export_scenes import moving_scene
from hexplane_grids import planes

from endoprior.core.geometry import project
from endoprior.initialization.first_gaussians import create_gaussians
from endoprior.model.carry import NUM_CARRIERS, carry, carry_points
from endoprior.model.hexplane_field import HexPlaneField
from endoprior.model.presets import preset
from endoprior.model.scene import SingleScene
from endoprior.model.surface import depth_at, project_visible, render_surface, shown_pixels, surface_points
from endoprior.model.uncertainty import point_errors

TIMES = [i / 10 for i in range(10)]


def still_scene():
    """The wall of `moving_scene` without motion."""
    scene = moving_scene()
    with torch.no_grad():
        scene.gaussians["motion"].zero_()
        scene.gaussians["frame_motion"].zero_()
    return scene


def confidence(scene, points, frames, times=TIMES):
    return point_errors(scene, carry(scene, points, frames, times), frames, range(len(times))).confidence


def test_a_point_moves_by_the_weighted_mean_of_its_carriers():
    scene, points, starts = moving_scene(), np.array([[1.0, 2, 60.2], [-3, 4, 59.4]]), np.array([0, 6])
    centers = np.stack([scene.at(time).means.numpy() for time in TIMES])
    opacities = scene.gaussians.opacities.detach().numpy()
    moved = carry_points(scene, points, starts, TIMES)
    for p, start in enumerate(starts):
        distance = np.linalg.norm(centers[start] - points[p], axis=1)
        nearest = distance.argsort()[:NUM_CARRIERS]
        weight = opacities[nearest] * np.exp(-0.5 * (distance[nearest] / distance[nearest].mean()) ** 2)
        for i in range(10):
            step = np.average(centers[i, nearest] - centers[start, nearest], axis=0, weights=weight)
            assert moved[i, p] == pytest.approx(points[p] + step, abs=1e-4)  # float32 near 60 mm


def test_confidence_falls_with_the_disagreement_of_the_carriers():
    scene, point = still_scene(), np.array([[0.5, 0.5, 60.1]])
    agreed = confidence(scene, point, np.array([0]))
    with torch.no_grad():
        scene.gaussians["motion"][:, :, 0] = 2.0
    together = confidence(scene, point, np.array([0]))
    assert together[0] == 1 and (together > 0.95).all(), "they move together"
    with torch.no_grad():  # every second Gaussian goes the other way in the later half
        half = scene.gaussians["motion"].shape[1] // 2
        scene.gaussians["motion"][::2, half:, 0] = -2.0
    torn = confidence(scene, point, np.array([0]))
    assert torn[0] == agreed[0] == 1 and (torn[7:] < 0.3).all() and (torn[7:] < torn[2:4].min()).all()
    later = confidence(scene, point, np.array([8]))
    assert later[8] == 1 and later[0] < 0.3, "backward in time too"


def test_confidence_is_counted_in_the_image():
    scene, point = moving_scene(), np.array([[0.5, 0.5, 60.1]])
    near = confidence(scene, point, np.array([0]))[5:]
    away = np.eye(4)
    away[2, 3] = 600
    far = replace(scene, cameras=tuple(replace(camera, world_to_camera=away) for camera in scene.cameras))
    behind = replace(scene, cameras=tuple(replace(camera, world_to_camera=-away) for camera in scene.cameras))
    assert (confidence(far, point, np.array([0]))[5:] > near).all()
    assert (confidence(behind, point, np.array([0]))[1:] == 0).all()
    larger = tuple(replace(c, width=128, height=96, fx=160.0, fy=160.0, cx=60.0, cy=52.0) for c in scene.cameras)
    same = confidence(replace(scene, cameras=larger), point, np.array([0]))[5:]
    assert same == pytest.approx(near, rel=1e-5), "px of an image 640 px wide"


def test_few_points_need_few_gaussians(monkeypatch):
    scene, evaluated = moving_scene(), []
    motion = type(scene.motion)
    before = motion.offsets

    def counting(self, gaussians, *others):
        evaluated.append(len(gaussians))
        return before(self, gaussians, *others)

    monkeypatch.setattr(motion, "offsets", counting)
    carry(scene, np.array([[0.5, 0.5, 60.1]]), np.array([3]), TIMES)
    assert sum(evaluated) <= len(scene) + NUM_CARRIERS * 11


def test_a_point_that_leaves_and_returns_is_visible_again():
    """It slides out of the image, lies under the tool, then behind tissue; each time it comes back."""
    scene = still_scene()
    camera = scene.cameras[0]
    inside, outside = np.array([0.5, 0.5, 60.1]), np.array([200.0, 0.5, 60.1])
    deep, close = inside * 1.1, inside * 1.03  # rendered depth is not exact to a few percent
    surface, tissue = render_surface(scene, 0.0, camera), np.ones((48, 64), bool)
    tool = tissue.copy()
    tool[20:35, 20:40] = False
    frames = [
        (inside, tissue),
        (outside, tissue),
        (inside, tissue),
        (inside, tool),
        (inside, None),
        (deep, None),
        (close, None),
        (deep, None),
    ]
    shown = [bool(project_visible(point[None], surface, mask)[1][0]) for point, mask in [*frames, (inside, tissue)]]
    assert shown == [True, False, True, False, True, False, True, False, True]


def test_a_surface_has_the_color_of_the_tissue_before_any_background(monkeypatch):
    scene = moving_scene()
    camera = scene.cameras[0]
    black = render_surface(scene, 0.0, camera)
    alpha = scene.render(0.0, camera).alpha.numpy()
    assert ((alpha > 0.5) & (alpha < 0.95)).any(), "where the background shows through"
    monkeypatch.setattr(type(scene), "background", (1.0, 1.0, 1.0))
    assert render_surface(scene, 0.0, camera).color == pytest.approx(black.color, abs=1e-5)


def test_surface_points_lie_where_their_own_frame_shows_them():
    scene, frames = moving_scene(), np.array([0, 6, 0])
    camera = scene.cameras[0]
    middle = [camera.width / 2, camera.height / 2]
    pixels = np.array([middle, middle, [1.0, 1.0]])  # no tissue is in the corner
    points = surface_points(scene, pixels, frames)
    assert np.isnan(points[2]).all()
    for point, frame in zip(points[:2], frames, strict=False):
        at, z = project(point[None], scene.cameras[frame])
        assert at[0] == pytest.approx(middle, abs=1e-3)
        assert z == pytest.approx(depth_at(render_surface(scene, frame / 10, scene.cameras[frame]), at), rel=1e-6)
    assert points[0, 2] != points[1, 2], "the tissue has moved"


def test_pixels_on_the_border_and_beyond():
    mask = np.ones((48, 64), bool)
    mask[:, 0] = False
    pixels = np.array([[0.5, 3], [1.0, 3], [64, 48], [64.1, 48], [-0.1, 3], [np.inf, 3]])
    assert shown_pixels(pixels, mask).tolist() == [False, True, True, False, False, False]


def test_a_hexplane_scene_carries_points_with_its_gaussians():
    cfg = preset("paper").fitted(20)
    hexplane = planes((5, 6, 7), 9, 8, (1, 2))
    cfg = replace(cfg, deformation=replace(cfg.deformation, hexplane=hexplane))
    points = np.random.default_rng(0).uniform(-10, 10, (40, 3)).astype(np.float32) + np.float32([0, 0, 60])
    gaussians = create_gaussians(points, np.full((40, 3), 0.5, np.float32), np.zeros(40, np.float32), cfg)
    field = HexPlaneField.from_points(gaussians["means"].detach(), cfg.deformation, torch.Generator().manual_seed(3))
    field.grid.values.uniform_(0.5, 1.5, generator=torch.Generator().manual_seed(4))
    for parameter in field.heads.parameters.values():
        parameter.data.normal_(generator=torch.Generator().manual_seed(5))
    scene = SingleScene(gaussians, field, cfg, moving_scene().cameras, 25.0, torch.zeros(40), torch.zeros(40))
    lone = scene.at(0.2).means[:1].numpy().astype(np.float64)
    carried = carry(scene, lone, np.array([2]), TIMES)
    spread = np.ptp([scene.at(time).means.numpy() for time in TIMES], axis=0).max()
    assert spread > 0.1 and carried.positions[2] == pytest.approx(lone, abs=1e-4)
    assert 0 < np.abs(carried.positions - lone).max() <= spread
