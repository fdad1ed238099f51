"""The camera path: whole paths of a relief, losses, rests, which path is taken, bad input."""

import re
from dataclasses import replace

import numpy as np
import pytest
from relief import HEIGHT, MATRIX, WIDTH, camera, path, pose, reader, smooth, view

from endoprior.core.checks import InputError
from endoprior.prepare.camera_path import colmap
from endoprior.prepare.camera_path import sequence_path as paths
from endoprior.prepare.camera_path.adjust import back_projected
from endoprior.prepare.camera_path.breathing import breathing_period
from endoprior.prepare.camera_path.features import new_corners, sampled, tracking_frame
from endoprior.prepare.camera_path.own import own_path
from endoprior.prepare.camera_path.pose_file import read_poses
from endoprior.prepare.camera_path.sequence_path import explained_share, find_path, sequence_path
from endoprior.prepare.camera_path.tracks import PoseInput, TrackingCamera

OPENCV = camera().matrix


def centers(paths):
    return paths[:, :3, 3]


def drift(found, true):
    """Largest distance of the centers, mm; both paths start at the origin."""
    return np.linalg.norm(centers(found) - centers(np.linalg.inv(true[0]) @ true), axis=1).max()


@pytest.fixture(scope="module")
def relief():
    """24 frames of a relief and their true poses."""
    true = path(24)
    return [view(p) for p in true], true


def test_a_path_is_recovered(relief):
    frames, true = relief
    found, _ = own_path(reader(frames), camera())
    assert found.explained.all() and not found.still.any()
    # 25 mm long, before a relief 80 mm away; tracks of 160 px images are good to about 0.1 px.
    assert drift(found.camera_to_world, true) < 0.4
    turn = np.linalg.inv(found.camera_to_world[:, :3, :3]) @ true[:, :3, :3]
    assert np.abs(turn - turn[0]).max() < 0.005
    assert np.nanmedian(found.translation_std) < 0.5 and np.all(found.depth_scale == 1)


def test_relative_depth_gets_one_scale_per_frame(relief):
    frames, true = relief
    factor = 1 + 0.2 * np.sin(np.arange(24))
    wrong = [replace(seen, depth=seen.depth * np.float32(f)) for seen, f in zip(frames, factor, strict=True)]
    found, _ = own_path(reader(wrong), camera(relative=True))
    product = found.depth_scale * factor
    assert np.ptp(product) / product.mean() < 0.02
    assert np.exp(np.median(np.log(found.depth_scale))) == pytest.approx(1)
    measured = found.camera_to_world.copy()
    measured[:, :3, 3] /= product.mean()
    assert drift(measured, true) < 1.5  # shape and scale of the depth are free


def test_a_lost_camera_is_found_again(relief):
    frames, true = relief
    other = [replace(frames[0], rgb_u8=smooth(HEIGHT, WIDTH, seed=9 + i)) for i in range(3)]
    order = [*range(12), *range(18, 24)]  # after the gap the camera is elsewhere
    seen = [*(frames[i] for i in order[:12]), *other, *(frames[i] for i in order[12:])]
    found, _ = own_path(reader(seen), camera())
    assert np.flatnonzero(~found.explained).tolist() == [12, 13, 14]
    assert all(np.array_equal(found.camera_to_world[i], found.camera_to_world[11]) for i in (12, 13, 14))
    kept = np.flatnonzero(found.explained)
    assert drift(found.camera_to_world[kept], true[order]) < 0.8


def test_a_leap_is_bridged(relief):
    frames, true = relief
    order = [0, 1, 2, 3, 14, 15, 16]
    found, _ = own_path(reader([frames[i] for i in order]), camera())
    assert found.explained.all() and drift(found.camera_to_world, true[order]) < 1.0


def test_rests_are_copied_exactly():
    rng = np.random.default_rng(0)
    stops = [path(5)[0]] * 12 + list(path(14)) + [path(14)[-1]] * 12
    seen = [view(p) for p in stops]
    seen = [
        replace(s, rgb_u8=np.clip(s.rgb_u8 + rng.normal(0, 1.5, s.rgb_u8.shape), 0, 255).astype(np.uint8)) for s in seen
    ]
    found, _ = own_path(reader(seen), camera())
    for span in (slice(0, 12), slice(26, 38)):
        assert found.still[span].all()
        assert np.ptp(found.camera_to_world[span], axis=0).max() == 0
    assert not found.still[15:23].any() and drift(found.camera_to_world, np.array(stops)) < 0.5


def test_pulled_tissue_does_not_move_the_camera():
    true = path(24)

    def pull(strength):
        return lambda x, y: strength * np.exp(-((x - 5) ** 2 + y**2) / 150)[..., None] * [5.0, -3.0]

    seen = [view(p, move=pull(np.sin(i / 4))) for i, p in enumerate(true)]
    found, follower = own_path(reader(seen), camera())
    assert found.explained.all() and drift(found.camera_to_world, true) < 0.8
    weight = follower.tracks.weight[: follower.tracks.count][follower.tracks.adjusted[: follower.tracks.count]]
    assert weight.min() < 0.1 < 0.5 < np.median(weight)


def test_the_true_path_explains_more_than_others(relief):
    frames, _ = relief
    found, follower = own_path(reader(frames), camera())
    right = explained_share(follower.tracks, camera(), found)
    resting = replace(found, camera_to_world=np.tile(np.eye(4), (24, 1, 1)))
    dropped = replace(found, explained=np.arange(24) % 2 == 0)
    assert right > 0.8 and explained_share(follower.tracks, camera(), resting) < 0.7 * right
    assert explained_share(follower.tracks, camera(), dropped) < 0.6 * right  # half of the frames are missing
    nothing = replace(found, explained=np.zeros(24, bool))
    assert explained_share(follower.tracks, camera(), nothing) == 0


@pytest.mark.parametrize("kind", ["black", "no depth", "all tool", "flat", "NaN depth"])
def test_frames_that_show_nothing_have_no_pose(kind, relief):
    good = relief[0][0]
    bad = {
        "black": replace(good, rgb_u8=np.zeros_like(good.rgb_u8)),
        "no depth": replace(good, depth=np.zeros_like(good.depth)),
        "all tool": replace(good, tissue_mask=np.zeros_like(good.tissue_mask)),
        "flat": replace(good, rgb_u8=np.full_like(good.rgb_u8, 128)),
        "NaN depth": replace(good, depth=np.full_like(good.depth, np.nan)),
    }[kind]
    found, _ = own_path(reader([bad, bad, bad]), camera())
    assert np.array_equal(found.camera_to_world, np.tile(np.eye(4), (3, 1, 1)))
    frames = [*relief[0][:5], bad, *relief[0][5:9]]
    found, _ = own_path(reader(frames), camera())
    assert np.isfinite(found.camera_to_world).all() and found.explained.sum() >= 9


def test_corners_keep_off_edges_tools_and_each_other(relief):
    seen = relief[0][0]
    mask = seen.tissue_mask.copy()
    mask[:, :40] = False
    depth = seen.depth.copy()
    depth[:, 100:] += 30
    seen = PoseInput(seen.rgb_u8, mask, depth)
    taken = np.array([[70.0, 60.0]], np.float32)
    corners = new_corners(tracking_frame(seen), taken)
    assert len(corners) > 20 and corners[:, 0].min() > 42
    assert (np.abs(corners[:, 0] - 99.5) > 1).all()
    assert np.hypot(*(corners - taken).T).min() >= 4
    assert sampled(depth, np.array([[np.nan, 1], [-5, 3], [1e9, 2]])).tolist() == [0, 0, 0]


def test_back_projection_inverts_projection():
    p = np.linalg.inv(pose([0.1, -0.2, 0.3], [3, 4, 5]))
    points = back_projected(OPENCV, p, np.array([[10.0, 20.0], [100.0, 70.0]]), np.array([50.0, 80.0]))
    seen = points @ p[:3, :3].T + p[:3, 3]
    assert np.allclose(seen[:, 2], [50, 80])
    assert np.allclose(seen[:, :2] / seen[:, 2:] * MATRIX[0, 0] + OPENCV[:2, 2], [[10, 20], [100, 70]])


@pytest.mark.slow
def test_the_better_path_is_taken(relief, monkeypatch):
    frames, _ = relief
    args = reader(frames), camera()
    monkeypatch.setattr(paths, "is_installed", lambda: False)
    own = find_path(*args)
    assert own.method == "our own tracks" and not own.notes
    with pytest.raises(InputError, match="expected the package pycolmap"):
        monkeypatch.setattr(paths, "install_command", lambda extra: f"pip install {extra}")
        find_path(*args, "colmap")
    worse = replace(own, method="COLMAP", camera_to_world=np.tile(np.eye(4), (24, 1, 1)))
    monkeypatch.setattr(paths, "is_installed", lambda: True)
    monkeypatch.setattr(paths, "colmap_path", lambda *args, **options: worse)
    assert find_path(*args).method == "our own tracks" and "COLMAP explains" in find_path(*args).notes[0]
    assert find_path(*args, "colmap").method == "COLMAP"
    monkeypatch.setattr(paths, "colmap_path", lambda *args, **options: None)
    assert "too few frames" in find_path(*args).notes[0]
    with pytest.raises(InputError, match="COLMAP can register"):
        find_path(*args, "colmap")


@pytest.mark.slow
@pytest.mark.skipif(not colmap.is_installed(), reason="needs pycolmap: pip install pycolmap")
def test_colmap_finds_the_path():
    true = path(24)
    found = find_path(reader([view(p) for p in true]), camera(), "colmap")
    assert found.method == "COLMAP" and found.explained.mean() > 0.9
    assert drift(found.camera_to_world, true) < 2.0


@pytest.mark.slow
def test_breathing_is_not_given_to_the_camera():
    true = path(60, 0.3)
    swell = [np.array([1.5 * np.sin(2 * np.pi * i / 15), 1.0 * np.cos(2 * np.pi * i / 15)]) for i in range(60)]

    def breath(i):
        return lambda x, y: swell[i] * (1 + 0.3 * np.sin(x / 14) * np.cos(y / 12))[..., None]

    seen = [view(p, move=breath(i)) for i, p in enumerate(true)]
    found, follower = own_path(reader(seen), camera())
    assert found.breathes and 14.5 < float(re.search(r"every ([0-9.]+) frames", found.notes[0])[1]) < 15.5
    off = centers(found.camera_to_world) - centers(true)
    leaked = np.linalg.norm(off - off.mean(0), axis=1)
    assert np.sqrt((leaked**2).mean()) < 0.5  # of 1.3 mm
    assert follower.tracks.weight[follower.tracks.adjusted].size > 50


def test_no_breath_where_nothing_repeats(relief):
    frames, _ = relief
    found, _ = own_path(reader([frames[i] for i in [*range(24), *range(22, -1, -1)]]), camera())
    assert not found.breathes


def test_a_period_is_found_to_a_tenth():
    rng = np.random.default_rng(0)
    frames, basis = rng.integers(0, 200, 1500), np.stack([np.ones(1500), rng.normal(size=1500)], 1)
    by_point = np.tile(np.eye(3), (1500, 1, 1))
    swing = 0.5 * (basis[:, 1] * np.sin(2 * np.pi * frames / 27.3))[:, None] * [1.0, 0.5, 0.0]
    error, weight = swing + rng.normal(0, 0.5, (1500, 3)), np.ones((1500, 3))
    assert breathing_period(error, by_point, weight, basis, frames, 200) == pytest.approx(27.3, abs=0.3)
    noise = rng.normal(0, 0.5, (1500, 3))
    assert breathing_period(noise, by_point, weight, basis, frames, 200) is None
    assert breathing_period(error, by_point, weight, basis, frames, 20) is None  # too short for three breaths


def test_a_static_camera_has_no_path(relief):
    frames = [relief[0][0]] * 6
    args = reader(frames), camera()
    assert sequence_path("still", *args) == (None, [])
    found, _ = sequence_path("own", *args)
    assert np.array_equal(found.camera_to_world, np.tile(np.eye(4), (6, 1, 1))) or not found.still.any()


def test_a_path_needs_depth(relief):
    frames, _ = relief
    args = reader(frames), camera()
    found, notes = sequence_path("auto", *args, has_depth=False)
    assert found is None and "without depth its path cannot be estimated" in notes[0]


def test_poses_from_a_file(tmp_path):
    poses = path(3)
    np.save(tmp_path / "p.npy", poses)
    assert np.allclose(read_poses(tmp_path / "p.npy", 3), poses)
    with pytest.raises(InputError, match=r"expected shape \(4, 4, 4\), one pose per frame, got \(3, 4, 4\)"):
        read_poses(tmp_path / "p.npy", 4)
    poses[1, 0, 0] = np.nan
    np.save(tmp_path / "p.npy", poses)
    with pytest.raises(InputError, match="expected finite numbers"):
        read_poses(tmp_path / "p.npy", 3)


def test_the_principal_point_may_lie_at_the_edge_of_the_image():
    """As after `--crop`: thresholds follow from the width of the image."""
    true = path(24)
    part = np.s_[:, 80:]
    cropped = [PoseInput(seen.rgb_u8[part], seen.tissue_mask[part], seen.depth[part]) for seen in map(view, true)]
    matrix = MATRIX - [[0, 0, 80], [0, 0, 0], [0, 0, 0]]
    right = TrackingCamera.centered_at_half(matrix, (WIDTH - 80, HEIGHT), False, 4.0)
    assert right.px == (WIDTH - 80) / 640 and right.with_focal(2.0).px == right.px
    found, _ = own_path(reader(cropped), right)
    off = found.camera_to_world[:, :3, 3] - (np.linalg.inv(true[0]) @ true)[:, :3, 3]
    assert found.explained.all() and np.linalg.norm(off, axis=1).max() < 2.0  # mm, by half of the view


@pytest.mark.slow
def test_a_mapping_that_was_stopped_is_told_whichever_path_is_taken(monkeypatch):
    assert not colmap.time_note(59.9, 60.0) and "stopped after 60 s" in colmap.time_note(60.2, 60.0)[0]
    frames = [view(pose) for pose in path(10, 2.0)]
    args = reader(frames), camera()
    monkeypatch.setattr(paths, "is_installed", lambda: True)
    own, _ = own_path(*args)
    at_rest = np.tile(np.eye(4), (len(frames), 1, 1))
    for poses, how, taken in ((at_rest, "best", own.method), (own.camera_to_world, "colmap", "COLMAP")):
        stopped = replace(own, method="COLMAP", camera_to_world=poses, notes=colmap.time_note(60.0, 60.0))
        monkeypatch.setattr(paths, "colmap_path", lambda *args, found=stopped, **options: found)
        found = paths.find_path(*args, how)
        assert found.method == taken and sum("stopped after 60 s" in note for note in found.notes) == 1


@pytest.mark.parametrize("moves", [True, False])
def test_auto_own_decides_as_auto_and_leaves_colmap_out(moves, monkeypatch):
    monkeypatch.setattr(paths, "is_installed", lambda: True)
    monkeypatch.setattr(paths, "colmap_path", lambda *args, **options: pytest.fail("COLMAP was asked"))
    frames = [view(pose) for pose in path(10, 2.0)] if moves else [view(path(1)[0])] * 10
    args = reader(frames), camera()
    found, notes = sequence_path("auto-own", *args)
    assert (found is not None) == moves and ("the camera moves" in notes[0]) == moves
    assert not moves or found.method == "our own tracks"
