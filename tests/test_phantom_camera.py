"""The phantom's moving camera: its path, the tissue it finds, and what is written against the true poses."""

from __future__ import annotations

import json
from dataclasses import replace

import cv2
import numpy as np
import pytest

from endoprior.core.geometry import bilinear
from endoprior.data import load_sequence
from endoprior.phantom import PhantomConfig, write_phantom
from endoprior.phantom import scene as making
from endoprior.phantom.camera import AT_ORIGIN, CameraPose, build_camera_path, widened
from endoprior.phantom.graspers import JAW_MM
from endoprior.phantom.instrument_families import instruments_of
from endoprior.phantom.instrument_tracing import pack, render_instruments
from endoprior.phantom.motion import ToolPose
from endoprior.phantom.raster import FAR, rasterize, vertex_normals
from endoprior.phantom.surface import build_anatomy, build_plane
from endoprior.phantom.views import render_tissue, visible_points

WALK = PhantomConfig(frames=20, width=96, height=80, seed=2, camera="inspect", stereo=True)
RIGID = replace(WALK, breathing_mm=0.0, pull_mm=0.0, noise=0.0)
FAR_FRAMES = 9, 10, 11
"""Frames of `RIGID` with the camera well away from its start."""


@pytest.fixture(scope="module")
def far_in_few_frames():
    """Excursions go as far in a few frames as they do in 300."""
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr("endoprior.phantom.camera.SLOW_FRAMES", (1, 1))
        yield


@pytest.fixture(scope="module")
def rigid(far_in_few_frames, tmp_path_factory):
    """A sequence in which only the camera and the tools move."""
    out = tmp_path_factory.mktemp("phantom") / "sequence"
    write_phantom(out, RIGID)
    return out


def poses_of(cfg):
    """(T, 4, 4) poses of a configuration."""
    return build_camera_path(cfg, build_plane(cfg)).poses(cfg.frames)


def turned_deg(rotations):
    """Angle of each rotation (..., 3, 3), degrees."""
    return np.degrees(np.arccos(np.clip((np.trace(rotations, axis1=-2, axis2=-1) - 1) / 2, -1, 1)))


def rays():
    """(H, W, 3) viewing rays of `RIGID` with z = 1, written out pixel by pixel."""
    out = np.ones((80, 96, 3))
    for i in range(80):
        for j in range(96):
            out[i, j, :2] = (j + 0.5 - 48) / (0.9 * 96), (i + 0.5 - 40) / (0.9 * 96)
    return out


def pixels_of(points):
    """(..., 2) where camera-space points are in the image of `RIGID`."""
    return 0.9 * 96 * points[..., :2] / points[..., 2:] + [48, 40]


# --- the path -------------------------------------------------------------------------------------------------------


def test_a_still_camera_stays_at_the_origin():
    assert np.array_equal(poses_of(replace(WALK, camera="still")), np.broadcast_to(np.eye(4), (20, 4, 4)))


@pytest.mark.parametrize("frames", [2, 40, 130, 300, 450, 1000])
def test_speeds_are_those_of_a_hand_and_the_path_returns(frames):
    for seed in range(12):
        poses = poses_of(replace(WALK, frames=frames, seed=seed))
        assert np.array_equal(poses[0], np.eye(4)) and np.array_equal(poses[-1], np.eye(4))
        rotations = poses[:, :3, :3]
        assert np.allclose(rotations @ rotations.transpose(0, 2, 1), np.eye(3), atol=1e-12)
        assert np.linalg.norm(np.diff(poses[:, :3, 3], axis=0), axis=-1).max() <= 3.0
        assert turned_deg(rotations[:-1].transpose(0, 2, 1) @ rotations[1:]).max() <= 1.2


def test_an_excursion_goes_as_far_as_it_should_and_rests():
    ways = []
    for seed in range(12):
        cfg = replace(WALK, frames=301, seed=seed)
        (trip,) = build_camera_path(cfg, build_plane(cfg)).excursions
        assert 15 <= np.linalg.norm(trip.pan) <= 25 and abs(trip.pan @ build_plane(cfg).axes[2]) < 1e-9
        assert 10 <= np.degrees(np.linalg.norm(trip.turn)) <= 15 and 10 <= abs(np.degrees(trip.roll)) <= 20
        assert 15 <= trip.retreat <= 25 and 10 <= trip.approach <= 20
        poses = poses_of(cfg)
        for first, last in ((0, 20), (73, 83), (289, 300)):  # at its start, after the pan, at its end
            assert np.array_equal(poses[first : last + 1], np.broadcast_to(poses[first], (last + 1 - first, 4, 4)))
        assert not np.array_equal(poses[72], poses[71]) and not np.array_equal(poses[84], poses[85])
        ways.append(trip.pan / np.linalg.norm(trip.pan))
    assert np.min(np.array(ways) @ np.transpose(ways)) < -0.3  # seeds go different ways


def test_each_excursion_starts_where_the_last_one_ends_and_goes_another_way():
    cfg = replace(WALK, frames=901)
    path = build_camera_path(cfg, build_plane(cfg))
    assert len(path.excursions) == 3
    assert all(np.array_equal(pose, np.eye(4)) for pose in path.poses(901)[[300, 600]])
    a, b, c = (trip.pan / np.linalg.norm(trip.pan) for trip in path.excursions)
    assert max(a @ b, b @ c) < 0.5


def test_the_optical_axis_turns_as_named():
    cfg = replace(WALK, frames=301)
    (trip,) = build_camera_path(cfg, build_plane(cfg)).excursions
    only = replace(trip, pan=np.zeros(3), pan_turn=np.zeros(2), roll=0.0, retreat=0.0, approach=0.0)
    pose = only.camera_to_world(0.5)  # fully turned
    assert turned_deg(pose[:3, :3]) == pytest.approx(np.degrees(np.linalg.norm(trip.turn)))
    # About (x, y) = (0, t) the axis turns to the right, about (t, 0) up (y points down).
    assert pose[:2, 2] == pytest.approx(np.array([trip.turn[1], -trip.turn[0]]), rel=0.02) and pose[1, 2] >= 0
    roll = replace(only, turn=np.zeros(2), roll=0.3).camera_to_world(0.6)
    assert np.allclose(roll[:3, 2], [0, 0, 1]) and roll[1, 0] == pytest.approx(np.sin(0.3))
    back = replace(only, turn=np.zeros(2), retreat=20.0).camera_to_world(0.57)
    assert np.allclose(back[:3, 3], [0, 0, -20.0])


# --- the tissue -----------------------------------------------------------------------------------------------------


def test_metric_plane_coordinates_and_grid_are_inverse():
    cfg = replace(WALK, frames=301)
    plane = widened(build_plane(cfg), build_camera_path(cfg, build_plane(cfg)), cfg)
    grid_u, grid_v = np.meshgrid([0.0, 0.3, 1.0], [0.1, 0.8], indexing="xy")
    a, b = plane.coordinates(grid_u, grid_v)
    assert np.allclose(plane.grid(a, b), (grid_u, grid_v), atol=1e-12)
    x0, x1, y0, y1 = plane.window
    assert np.allclose(a, x0 + grid_u * (x1 - x0)) and np.allclose(b, y0 + grid_v * (y1 - y0))


def test_loops_in_the_middle_stay_and_more_surround_them():
    usual, wide = build_anatomy(3), build_anatomy(3, (-120, 120, -100, 90))
    count = len(usual.paths)
    assert len(wide.paths) > count + 5 and np.array_equal(wide.liver_edge, usual.liver_edge)
    for name in ("paths", "radii", "bases"):
        assert np.array_equal(getattr(wide, name)[:count], getattr(usual, name)), name
    assert np.abs(wide.paths[count:]).max() > 85


@pytest.mark.slow
@pytest.mark.parametrize(
    "change",
    [
        {"breathing_mm": 8.0, "pull_mm": 30.0, "slide_mm": 12.0},
        pytest.param({"seed": 0, "principal_x": 36.0}, marks=pytest.mark.slow),
        pytest.param({"seed": 1, "frames": 1000}, marks=pytest.mark.slow),
        pytest.param({"seed": 3, "width": 80, "height": 100, "focal_per_width": 1.0}, marks=pytest.mark.slow),
    ],
)
def test_no_pose_shows_the_end_of_the_tissue(change, monkeypatch):
    monkeypatch.setattr(making, "build_texture", lambda *_: np.zeros((2, 2, 7), np.float32))
    cfg = replace(WALK, **{"frames": 301, **change})
    scene = making.build_scene(cfg)
    for phase in np.linspace(0, 1, 26):
        vertices = scene.seen_vertices(phase)
        for eye in (AT_ORIGIN, CameraPose.moved_right(cfg.baseline_mm)):
            z = rasterize(eye.to_camera(vertices), cfg.focal, cfg.center, cfg.width, cfg.height)[..., 2]
            assert z.max() < FAR and 30 < z.min() and 45 < np.median(z) < 130


def test_what_is_behind_the_camera_is_neither_drawn_nor_visible():
    # A floor below the camera that reaches from 40 mm behind it to 100 mm before it.
    x, z = np.meshgrid(np.linspace(-60, 60, 25), np.linspace(100, -40, 29))
    vertices = np.stack([x, np.full_like(x, 20.0), z], -1)
    hits = rasterize(vertices, 60.0, (32.0, 24.0), 64, 48)
    assert np.isfinite(hits).all() and (hits[:24, :, 2] == FAR).all()  # nothing above the horizon
    rows = np.arange(40, 48)
    assert np.allclose(hits[40:, 32, 2], 20 * 60 / (rows + 0.5 - 24), rtol=1e-4)
    cfg = replace(WALK, camera="still")
    near = np.array([[0, 0, 60.0], [0, 0, -60.0], [0, 0, 0.0]])
    with np.errstate(all="raise"):
        seen = visible_points(near, np.full((80, 96), 60, np.float32), np.zeros((80, 96), bool), cfg)
    assert seen.tolist() == [True, False, False]


# --- tools and light ------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("moved", [False, True])
def test_a_tool_in_the_world_closed_form(moved):
    """Every point seen on a grasper's shaft lies one radius (3.25 mm) from its axis, wherever the camera is."""
    pose = ToolPose(np.array([-80.0, 10.0, 60.0]), np.array([20.0, 0.0, 70.0]), 0.2, 0.0)
    tools, poses, where = instruments_of("graspers", 0), (pose, pose), (np.zeros(3), 80.0, (48.0, 40.5))
    numbers = pack(pose, tools[0], 0, 0).astype(float)
    wrist, back = numbers[:3], numbers[3:6]
    turn = cv2.Rodrigues(np.array([0.1, -0.15, 0.2]))[0]
    endoscope = CameraPose(np.array([8.0, -5.0, -12.0]), turn) if moved else AT_ORIGIN
    wall, z = np.zeros((80, 96, 3), np.float32), np.full((80, 96), 120, np.float32)
    color, depth = render_instruments(poses, tools, 0, wall, z, *where, endoscope)
    y, x = np.nonzero(depth < FAR)
    points = np.stack([(x + 0.5 - 48) / 80, (y + 0.5 - 40.5) / 80, np.ones(len(x))], -1) * depth[y, x, None]
    world = points @ endoscope.rotation.T + endoscope.center
    along = (world - wrist) @ back
    radial = np.linalg.norm(world - wrist - along[:, None] * back, axis=-1)
    # Tracing stops 0.012 mm from the surface.
    assert (along > 13).sum() > 100 and np.allclose(radial[along > 13], 3.25, atol=0.02)
    assert radial.max() < 0.6 * JAW_MM and along.min() > -JAW_MM - 0.5
    assert np.isfinite(color).all() and (color[y, x] > 0).all() and (color[depth >= FAR] == 0).all()
    assert (render_instruments(poses, tools, 0, wall, z - 100, *where, endoscope)[1] == FAR).all()  # hidden by tissue


@pytest.fixture(scope="module")
def standing():
    """A scene whose camera stands still, to be placed by hand."""
    return making.build_scene(replace(RIGID, camera="still"))


def tissue_from(scene, pose):
    """Radiance and z of the tissue in the first frame, seen from `pose` (4, 4)."""
    endoscope = CameraPose.of(pose)
    vertices = endoscope.to_camera(scene.vertices(0.0))
    now = making.SceneState(endoscope, vertices, vertex_normals(vertices), scene.motion.tools(0.0))
    return render_tissue(scene, now, AT_ORIGIN)


def test_light_comes_with_the_camera(standing):
    """Where the camera has retreated, the same tissue is darker: by about the square of the distance."""
    pose = np.eye(4)
    pose[2, 3] = -20.0
    (near, near_z), (far, far_z) = tissue_from(standing, np.eye(4)), tissue_from(standing, pose)
    middle = np.s_[30:50, 38:58]
    distance = np.median(near_z[middle]), np.median(far_z[middle])
    assert distance[1] - distance[0] == pytest.approx(20, abs=2)
    darker = np.median(far[middle]) / np.median(near[middle])
    assert darker == pytest.approx((distance[0] / distance[1]) ** 2, rel=0.2)


def test_relief_and_shape_stay_on_the_tissue_when_the_camera_rolls(standing, monkeypatch):
    """With one light in the lens, a camera that stands on its head sees the same picture upside down."""
    monkeypatch.setattr("endoprior.phantom.shading.LIGHTS_MM", np.zeros((1, 3), np.float32))
    upright, z = tissue_from(standing, np.eye(4))
    turned, turned_z = tissue_from(standing, np.diag([-1.0, -1.0, 1.0, 1.0]))
    assert np.allclose(turned_z[::-1, ::-1], z, rtol=1e-4)
    assert np.percentile(np.abs(turned[::-1, ::-1] - upright), 99) < 0.01 * np.median(upright)


# --- the written folder ---------------------------------------------------------------------------------------------


@pytest.mark.slow
def test_poses_are_written_twice_and_read(rigid):
    poses = np.load(rigid / "truth/camera_to_world.npy")
    assert poses.shape == (20, 4, 4) and poses.dtype == np.float64
    stored = np.load(rigid / "poses_bounds.npy")[:, :15].reshape(20, 3, 5)
    assert np.array_equal(stored[:, :, :4], poses[:, :3])
    assert np.array_equal(poses[0], np.eye(4)) and np.array_equal(poses[-1], np.eye(4))
    assert np.linalg.norm(poses[:, :3, 3], axis=-1).max() > 15
    sequence = load_sequence(rigid)
    for index in (0, 7, 12):
        assert np.allclose(sequence.camera(index).world_to_camera @ poses[index], np.eye(4), atol=1e-9)


def test_depth_of_one_frame_is_that_of_another_through_their_poses(rigid):
    poses = np.load(rigid / "truth/camera_to_world.npy")
    depth = [np.load(rigid / f"truth/depth/{i:06d}.npy") for i in range(20)]
    for one, other in ((0, 5), (0, 9), (5, 12), (8, 15)):
        world = (rays() * depth[one][..., None]) @ poses[one, :3, :3].T + poses[one, :3, 3]
        there = (world - poses[other, :3, 3]) @ poses[other, :3, :3]
        at = pixels_of(there)
        inside = (at > 1).all(-1) & (at < [95, 79]).all(-1)
        error = np.abs(bilinear(depth[other], at)[inside] - there[inside][:, 2])
        assert inside.mean() > 0.3
        assert np.median(error) < 0.05 and np.median(np.abs(depth[one] - depth[other])) > 1


def test_frames_with_one_pose_and_no_motion_show_the_same_tissue(rigid):
    first, last = (cv2.imread(str(rigid / f"truth/tissue/{i:06d}.png")) for i in (0, 19))
    assert np.array_equal(first, last)


def test_tracks_stand_still_in_the_world_and_lie_on_the_tissue(rigid):
    poses = np.load(rigid / "truth/camera_to_world.npy")
    tracks = np.load(rigid / "truth/tracks.npz")
    points, visible = tracks["points"].astype(float), tracks["visible"]
    for index, pose in enumerate(poses):
        for p in range(0, points.shape[1], 16):
            world = pose[:3, :3] @ points[index, p] + pose[:3, 3]
            assert np.allclose(world, points[0, p], atol=1e-4)  # the first pose is the identity
        p = points[index][visible[index]]
        at = pixels_of(p)
        assert (at >= 0).all() and (at <= [96, 80]).all()
        z = np.load(rigid / f"truth/depth/{index:06d}.npy")
        assert np.median(np.abs(bilinear(z, at) - p[:, 2])) < 0.1


def test_points_that_come_into_view_later_are_tracked(rigid):
    visible = np.load(rigid / "truth/tracks.npz")["visible"]
    later = ~visible[:2].any(0) & visible.any(0)
    assert later.mean() > 0.1
    assert visible[list(FAR_FRAMES)].mean() > 0.35


def test_right_image_is_the_left_one_shifted_by_disparity_from_every_pose(rigid):
    for index in (0, *FAR_FRAMES):
        left, right = (
            cv2.imread(str(rigid / f"{name}/{index:06d}.png")).astype(float) for name in ("truth/tissue", "right")
        )
        tool = cv2.imread(str(rigid / f"masks/{index:06d}.png"), 0) > 0
        z = np.load(rigid / f"truth/depth/{index:06d}.npy")
        x, y = np.meshgrid(np.arange(96) + 0.5, np.arange(80) + 0.5)
        disparity = 0.9 * 96 * 4.2 / z
        interior = (x - disparity > 1) & ~cv2.dilate(tool.astype(np.uint8), np.ones((3, 25), np.uint8)).astype(bool)
        gap = {
            shift: np.abs(bilinear(right, np.stack([x - shift * disparity, y], -1)) - left)[interior].mean()
            for shift in (0.0, 0.7, 1.0, 1.3)
        }
        assert gap[1.0] < 0.85 * min(gap[0.7], gap[1.3]) and gap[1.0] < 0.5 * gap[0.0]


def test_side_cameras_stand_beside_the_camera_of_their_frame(rigid):
    sides = json.loads((rigid / "truth/side/world_to_camera.json").read_text())
    checked = 0
    for name, pose in sides.items():
        for path in sorted((rigid / "truth/side" / name).glob("*.npy"))[1:]:
            seen, index = np.load(path), int(path.stem)
            front = np.load(rigid / f"truth/depth/{index:06d}.npy")
            pose_ = np.array(pose)
            points = ((rays() * seen[..., None])[seen > 0] - pose_[:3, 3]) @ pose_[:3, :3]
            assert np.median(np.abs(bilinear(front, pixels_of(points)) - points[:, 2])) < 0.1
            checked += 1
    assert checked >= len(sides)


def test_seen_tissue_behind_tools_is_below_the_mask(rigid):
    for path in sorted((rigid / "truth/seen").glob("*.npy")):
        tool = cv2.imread(str(rigid / f"masks/{path.stem}.png"), 0) > 0
        assert not (np.load(path) & ~tool).any()
        # The camera goes around the tools: it sees more than half of what they hide in one frame.
        assert np.load(path).sum() > 0.5 * tool.sum()
