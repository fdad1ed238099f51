"""The second look at a path: direct matches in closed form, then cameras and lens on a known relief."""

from __future__ import annotations

from dataclasses import replace

import cv2
import numpy as np
import pytest
from relief import HEIGHT, WIDTH, camera, path, pose, reader, view

from endoprior.prepare.camera_path import sequence_path as paths
from endoprior.prepare.camera_path.path import CameraPath
from endoprior.prepare.camera_path.refine import FITS_PX, match_frames, refined_path

SIZE, COUNT = (WIDTH, HEIGHT), 24
RELATIVE = camera(relative=True)
ASSUMED = replace(RELATIVE, focal_is_assumed=True)
ALL = np.ones(COUNT, bool)


@pytest.fixture(scope="module")
def relief():
    """Frames of a relief, whose depth is wrong by a smooth field, and their true poses."""
    rows, columns = np.indices((HEIGHT, WIDTH))
    wrong = 1 + 0.06 * np.sin(columns / 25) + 0.06 * np.cos(rows / 30)
    true = path(COUNT)
    return [replace(seen, depth=(seen.depth * wrong).astype(np.float32)) for seen in map(view, true)], true


def drifted(true, turn_degrees):
    """Poses that turn away slowly and come back, with centers that do too."""
    phase = np.sin(np.arange(len(true)) / 4)
    out = true.copy()
    for p, f in zip(out, phase, strict=True):
        p[:3, :3] = p[:3, :3] @ cv2.Rodrigues(np.radians(turn_degrees) * f * np.array([1.0, -0.7, 0.4]))[0]
        p[:3, 3] += f * np.array([0.3, -0.2, 0.4])
    return CameraPath(out, np.ones(len(true), bool), np.ones(len(true)))


def turn_error(found, true):
    """Largest error of the turn between neighbors three frames apart, degrees."""

    def turns(poses):
        return np.linalg.inv(poses[:-3, :3, :3]) @ poses[3:, :3, :3]

    between = np.linalg.inv(turns(found)) @ turns(true)
    return np.degrees(np.arccos(np.clip((np.trace(between, axis1=1, axis2=2) - 1) / 2, -1, 1))).max()


def test_a_corner_is_found_where_the_partner_sees_it_though_depth_is_a_guess(relief):
    frames, true = relief
    found = list(match_frames(reader(frames), np.linalg.inv(true), ALL, RELATIVE.matrix, SIZE))
    matches = found[12]
    z = view(true[12]).depth[tuple(np.round(matches.pixels[:, ::-1]).astype(int).T)]
    rays = np.concatenate([matches.pixels, np.ones((len(z), 1))], 1) @ np.linalg.inv(RELATIVE.matrix).T
    world = (rays * z[:, None]) @ true[12][:3, :3].T + true[12][:3, 3]
    for j, seen in zip(matches.partners, matches.seen, strict=True):
        there = (world - true[j][:3, 3]) @ true[j][:3, :3] @ RELATIVE.matrix.T
        error = np.linalg.norm(seen - there[:, :2] / there[:, 2:], axis=1)
        assert np.isfinite(error).sum() > 40 and np.nanmedian(error) < 0.15


def test_a_path_that_drifts_and_a_focal_length_that_is_wrong_are_mended(relief):
    frames, true = relief
    before, wrong = drifted(true, 0.4), ASSUMED.with_focal(1.06)
    found = refined_path(before, reader(frames), wrong)
    assert found.fits and found.residual_px < 0.6 * FITS_PX
    assert turn_error(before.camera_to_world, true) > 0.3 > 0.1 > turn_error(found.path.camera_to_world, true)
    assert found.path.focal_factor == pytest.approx(1 / 1.06, rel=0.012)
    assert np.allclose(found.path.camera_to_world[0], np.eye(4))
    fixed = refined_path(before, reader(frames), RELATIVE)
    assert fixed.path.focal_factor == 1 and turn_error(fixed.path.camera_to_world, true) < 0.1


def test_the_scale_of_each_frame_follows():
    true, factor = path(COUNT), 1 + 0.1 * np.sin(np.arange(COUNT))
    frames = [replace(view(p), depth=(view(p).depth * f).astype(np.float32)) for p, f in zip(true, factor, strict=True)]
    found = refined_path(drifted(true, 0.0), reader(frames), RELATIVE).path
    reach = np.linalg.norm(found.camera_to_world[-1, :3, 3]) / np.linalg.norm(true[-1, :3, 3] - true[0, :3, 3])
    assert np.allclose(found.depth_scale * factor, reach, rtol=0.02)


def test_tissue_that_moves_by_itself_fits_no_camera():
    true = path(COUNT)

    def pulled(i):
        return lambda x, y: np.stack([2.5 * np.sin(i / 2 + x / 15), 2.5 * np.cos(i / 3 + y / 12)], -1)

    frames = [view(p, move=pulled(i)) for i, p in enumerate(true)]
    found = refined_path(drifted(true, 0.0), reader(frames), RELATIVE)
    assert not found.fits


def test_frames_of_a_rest_keep_one_pose_and_lost_frames_that_of_the_frame_before(relief):
    frames, true = relief
    explained = ALL.copy()
    explained[18] = False
    poses = drifted(true, 0.3).camera_to_world
    poses[9:14], poses[18] = poses[9], poses[17]
    seen = [frames[9] if 9 <= i < 14 else frame for i, frame in enumerate(frames)]
    before = CameraPath(poses, explained, np.ones(COUNT))
    found = refined_path(before, reader(seen), RELATIVE).path.camera_to_world
    assert (found[9:14] == found[9]).all() and (found[18] == found[17]).all()
    assert not (found[8] == found[9]).all()


def test_without_parallax_there_is_nothing_to_adjust():
    turns = np.stack([pose((0, 0.01 * i, 0), (0, 0, 0)) for i in range(8)])
    still = CameraPath(turns, np.ones(8, bool), np.ones(8))
    assert refined_path(still, reader([view(p) for p in turns]), ASSUMED) is None


def test_a_path_is_taken_only_if_it_fits_and_still_explains_the_tracks(relief, monkeypatch):
    frames, true = relief
    args = reader(frames), RELATIVE, "own"
    found = paths.find_path(*args)
    assert any(paths.FIT in note for note in found.notes)
    assert turn_error(found.camera_to_world, true) < 0.1
    monkeypatch.setattr(paths, "STILL_EXPLAINED", 2.0)
    kept = paths.find_path(*args)
    assert not any(paths.FIT in note for note in kept.notes)
    monkeypatch.setattr("endoprior.prepare.camera_path.refine.FITS_PX", 0.0)
    assert any(paths.UNFIT in note for note in paths.find_path(*args).notes)
