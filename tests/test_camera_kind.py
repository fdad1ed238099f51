"""Whether and how the camera moves, said with evidence: direct alignment, static where shown, forward in a tube."""

import json
from dataclasses import replace
from itertools import pairwise

import cv2
import numpy as np
import pytest

from endoprior.evaluation.scorers.camera_path import trajectory_errors
from endoprior.footage.alignment import align, mean_shift
from endoprior.footage.camera_motion import camera_motion
from endoprior.phantom import PhantomConfig, write_phantom
from endoprior.prepare.camera_path.features import followed, followed_directly, new_corners, tracking_frame
from endoprior.prepare.camera_path.path import CameraPath, path_motion
from endoprior.prepare.camera_path.sequence_path import path_depth, sequence_path
from endoprior.prepare.camera_path.tracks import FrameReader, PoseInput, TrackingCamera, Tracks
from endoprior.prepare.relative_depth import fit_shading

SIZE = 320, 240
CAMERA = TrackingCamera(np.array([[230.0, 0, 160], [0, 230.0, 120], [0, 0, 1]]), SIZE, True)


def soft(seed, blur=9.0):
    """(H, W) gray image whose details are too large for corners."""
    noise = np.random.default_rng(seed).normal(size=SIZE[::-1]).astype(np.float32)
    noise = cv2.GaussianBlur(noise, (0, 0), blur)
    return np.clip(128 + 40 * noise / noise.std(), 20, 240).astype(np.uint8)


def shifted(image, shift=(0.0, 0.0), degrees=0.0, zoom=1.0):
    """The image moved, and the (3, 3) transform that moves it."""
    matrix = cv2.getRotationMatrix2D((SIZE[0] / 2, SIZE[1] / 2), degrees, zoom)
    matrix[:, 2] += shift
    moved = cv2.warpAffine(image, matrix, SIZE, borderMode=cv2.BORDER_REFLECT)
    return moved, np.vstack([matrix, [0, 0, 1]])


def color(gray):
    return np.stack([gray] * 3, -1)


@pytest.mark.parametrize("how", [{"shift": (17.0, -9.0)}, {"degrees": 6.0}, {"zoom": 1.1}])
def test_a_motion_is_found_without_corners_and_with_other_brightness(how):
    moved, matrix = shifted(soft(1), **how)
    darker = np.clip(moved * 0.7 + 12, 0, 255).astype(np.uint8)
    found = align(soft(1), darker)
    assert found is not None and mean_shift(np.linalg.inv(matrix) @ found, *SIZE) < 0.7


def test_another_scene_a_flat_wall_and_a_dark_border_fit_nothing():
    flat = np.random.default_rng(0).normal(120, 2, SIZE[::-1]).astype(np.uint8)
    assert all(align(soft(k), soft(k + 1)) is None for k in range(2, 8)) and align(flat, flat[::-1].copy()) is None
    inside = np.hypot(*np.meshgrid(np.arange(320) - 160, np.arange(240) - 120)) < 110
    assert align(np.where(inside, soft(2), 0).astype(np.uint8), np.where(inside, soft(3), 0).astype(np.uint8)) is None


def test_static_is_said_only_where_it_was_shown():
    still, lost = [color(soft(1))] * 12, [color(soft(k)) for k in range(20, 32)]
    assert camera_motion(still).kind == "static"
    bridged = camera_motion([*still[:6], color(soft(9)), *still[6:]])  # one bad frame is stepped over
    assert bridged.kind == "static" and bridged.resting.sum() == 12 and not bridged.resting[6]
    half = camera_motion([*still, *lost])
    assert (
        half.kind == "unknown" and "unknown" in half.text and np.flatnonzero(half.resting).tolist() == list(range(12))
    )
    drift = camera_motion([color(shifted(soft(1), (4.0 * k, 0))[0]) for k in range(12)] + lost)
    assert drift.moving and drift.resting.sum() == 5  # 4 px a step, of 19 px


@pytest.mark.parametrize("rests", [10, 3])
def test_an_unknown_motion_claims_no_poses(rests):
    images = [color(soft(1))] * rests + [color(soft(k)) for k in range(20, 32)]
    everything, depth = np.ones(SIZE[::-1], bool), np.full(SIZE[::-1], 70, np.float32)
    frames = FrameReader(images.__getitem__, lambda _k: everything, lambda _k: depth, len(images))
    path, notes = sequence_path("auto-own", frames, CAMERA)
    assert path is not None and path.kind == "unknown" == path.sources({})["camera motion"]
    assert path.explained.tolist() == [k < rests and rests >= 8 for k in range(len(images))]
    assert "unknown" in notes[0] and ("one camera serves" if rests >= 8 else "no model is possible") in notes[0]


def test_what_stays_on_the_lens_is_not_followed_where_corners_are_few():
    pattern = cv2.GaussianBlur(np.random.default_rng(5).normal(size=SIZE[::-1]), (0, 0), 1.0)  # of sensor or fibers
    pattern, views = pattern * 4 / pattern.std(), []
    for shift in (0.0, 6.0):
        gray = np.clip(128 + 0.15 * (shifted(soft(1, 6.0), (shift, 0))[0] - 128.0) + pattern, 0, 255).astype(np.uint8)
        seen = PoseInput(color(gray), np.ones(SIZE[::-1], bool), np.full(SIZE[::-1], 70, np.float32))
        views.append([tracking_frame(seen), tracking_frame(seen, coarse=True)])
    fine, coarse = zip(*views, strict=True)
    none = np.zeros((0, 2), np.float32)
    corners = new_corners(fine[0], none)
    kept, there = followed(*fine, corners)
    assert np.mean(np.abs(there - corners[kept]).max(1) < 1) > 0.7
    corners = new_corners(coarse[0], none)
    found = followed_directly(*coarse, corners)
    assert found is not None and len(found[0]) > 200
    assert np.median(found[1][:, 0] - corners[found[0]][:, 0]) > 3.5  # the pattern still pulls
    assert np.mean(np.abs(found[1] - corners[found[0]]).max(1) < 1) < 0.02


def test_a_border_does_not_hold_corners_where_they_are():
    y, x = np.mgrid[: SIZE[1], : SIZE[0]]
    tissue, views = np.hypot(x - SIZE[0] / 2, y - SIZE[1] / 2) < 0.45 * SIZE[1], []
    for shift in (0.0, 4.0):
        gray = 70 + 0.5 * (shifted(soft(1), (shift, 0))[0] - 128.0) + 30 * x / SIZE[0]
        image = np.where(tissue, gray, 0).astype(np.uint8)
        views.append(tracking_frame(PoseInput(color(image), tissue, np.full(SIZE[::-1], 70, np.float32))))
    corners = new_corners(views[0], np.zeros((0, 2), np.float32))
    kept, there = followed(*views, corners)
    way = there[:, 0] - corners[kept][:, 0]
    assert len(kept) > 100 and np.mean(way < 1.2) < 0.02 and np.mean(np.abs(way - 4) < 0.5) > 0.8


def path_of(step, turn_degrees=0.0):
    """A path of 20 frames with one way (3,) and one turn a step, and tracks at 50 mm."""
    pose, motion = np.eye(4), np.eye(4)
    motion[:3, :3], motion[:3, 3] = cv2.Rodrigues(np.deg2rad([0, turn_degrees, 0]))[0], step
    poses = [pose := pose @ motion for _ in range(20)]
    tracks = Tracks(CAMERA)
    ids = tracks.add_points(np.zeros((1, 3)), keypoint=False)
    for frame in range(20):
        tracks.see(frame, ids, np.zeros((1, 2)), np.full(1, 50.0))
    return path_motion(CameraPath(np.stack(poses), np.ones(20, bool), np.ones(20)), tracks, CAMERA)


def test_the_kind_of_a_path_is_where_it_leads():
    assert path_of((0, 0, 0.8)).kind == "forward" and path_of((0, 0, -0.8)).kind == "backward"
    assert path_of((0.5, 0, 0.1)).kind == "translating" and path_of((0, 0, 0), 0.5).kind == "turning"
    assert path_of((0.002, 0, 0)).kind == "static"
    aside = path_of((0.9, 0, 0))  # 4.1 px a step
    assert np.allclose(aside.shift_px, 0.9 / 50 * 230)
    assert not aside.contradicts(np.full(19, 4.0)) and aside.contradicts(np.full(19, 0.1))
    assert not aside.contradicts(np.full(19, np.nan))


@pytest.mark.slow
def test_path_and_depth_in_a_tube_are_right_to_five_percent(tmp_path):
    cfg = PhantomConfig(scene="tube", frames=48, width=320, height=256, seed=3)
    write_phantom(tmp_path / "data", cfg)
    images = [cv2.imread(str(f))[..., ::-1].copy() for f in sorted((tmp_path / "data/images").iterdir())]
    everything = np.ones(images[0].shape[:2], bool)
    shading = fit_shading(images[::4], [everything] * 12)
    depths = [shading.depth(image, everything) for image in images]
    frames = FrameReader(images.__getitem__, lambda _k: everything, depths.__getitem__, 48)
    matrix = np.array([[cfg.focal, 0, cfg.center[0]], [0, cfg.focal, cfg.center[1]], [0, 0, 1]])
    camera = TrackingCamera.centered_at_half(matrix, (cfg.width, cfg.height), True)
    path, _ = sequence_path("auto-own", frames, camera)
    true = np.load(tmp_path / "data/truth/camera_to_world.npy")
    assert path is not None and path.explained.all() and path.kind == "forward"
    length = sum(np.linalg.norm(b[:3, 3] - a[:3, 3]) for a, b in pairwise(true))
    assert trajectory_errors(path.camera_to_world, true, True).ate_mm < 0.05 * length
    errors = []
    for k in range(0, 48, 6):
        z = path_depth(path, k, np.round(depths[k] / 0.01).astype(np.uint16), 0.01) * 0.01
        truth = np.load(tmp_path / f"data/truth/depth/{k:06d}.npy")
        ratio = z / truth
        errors.append((np.median(ratio), np.median(np.abs(ratio / np.median(ratio) - 1))))
        flat = depths[k] / truth
        assert errors[-1][1] < 0.6 * np.median(np.abs(flat / np.median(flat) - 1))
    assert np.mean(errors, 0)[1] < 0.05 and np.ptp(errors, 0)[0] < 0.1 * np.mean(errors, 0)[0]
    assert json.loads(json.dumps(path.record()))["camera_motion"] == "forward"
    assert replace(path, is_unknown=True).kind == "unknown"
