"""`endoprior phantom --scene tube` and `sinus`: path, depth and tracks agree, and the lamp with 1/z^2."""

from dataclasses import replace

import cv2
import numpy as np
import pytest

from endoprior.core.checks import InputError
from endoprior.data import load_sequence
from endoprior.phantom import PhantomConfig, write_phantom

SMALL = PhantomConfig(scene="tube", frames=8, width=96, height=80, tracks=200)
SINUS = replace(SMALL, scene="sinus", border="oval", focal_per_width=0.6)


@pytest.fixture(scope="module")
def tube(tmp_path_factory):
    folder = tmp_path_factory.mktemp("tube") / "data"
    write_phantom(folder, SMALL)
    return folder


@pytest.fixture(scope="module")
def sinus(tmp_path_factory):
    folder = tmp_path_factory.mktemp("sinus") / "data"
    write_phantom(folder, SINUS)
    return folder


@pytest.mark.parametrize(("scene", "cfg"), [("tube", SMALL), ("sinus", SINUS)])
def test_true_tracks_lie_on_the_true_depth_and_on_one_rigid_wall(scene, cfg, request):
    tube = request.getfixturevalue(scene)
    tracks, poses = np.load(tube / "truth/tracks.npz"), np.load(tube / "truth/camera_to_world.npy")
    points, visible = tracks["points"].astype(np.float64), tracks["visible"]
    assert visible.sum() > 500
    world = np.einsum("tij,tpj->tpi", poses[:, :3, :3], points) + poses[:, None, :3, 3]
    assert np.abs(world - world[:1]).max() < 1e-3
    for frame in range(cfg.frames):
        depth = np.load(tube / f"truth/depth/{frame:06d}.npy")
        seen = points[frame][visible[frame]]
        x, y = (cfg.focal * seen[:, k] / seen[:, 2] + cfg.center[k] for k in (0, 1))
        assert np.median(np.abs(depth[y.astype(int), x.astype(int)] - seen[:, 2]) / seen[:, 2]) < 0.02


def test_the_camera_drives_forward_and_a_lumen_is_deep_and_dark(tube):
    poses = np.load(tube / "truth/camera_to_world.npy")
    steps = np.einsum("tji,tj->ti", poses[:-1, :3, :3], np.diff(poses[:, :3, 3], axis=0))
    assert (steps[:, 2] > 0.5 * np.linalg.norm(steps, axis=1)).all()
    depth = np.load(tube / "truth/depth/000000.npy")
    image = cv2.imread(str(tube / "truth/tissue/000000.png")).mean(2)
    far = depth > np.percentile(depth, 90)
    assert depth.max() > 3 * np.median(depth) and image[far].mean() < 0.6 * image[~far].mean()
    sequence = load_sequence(tube)
    assert len(sequence) == 8 and np.allclose(sequence.camera(3).world_to_camera, np.linalg.inv(poses[3]), atol=1e-3)


def test_the_sinus_is_narrow_and_its_camera_turns_slowly_within_a_black_border(sinus):
    poses, border = np.load(sinus / "truth/camera_to_world.npy"), np.load(sinus / "truth/border.npy")
    turns = np.einsum("tji,tjk->tik", poses[:-1, :3, :3], poses[1:, :3, :3])
    degrees = np.rad2deg(np.arccos((np.trace(turns, axis1=1, axis2=2) - 1) / 2))
    assert 0.05 < degrees.min() and degrees.max() < 0.6
    depth = np.load(sinus / "truth/depth/000000.npy")
    assert 4 < depth.min() < 15 and 40 < depth.max() < 100
    image, mask = (cv2.imread(str(sinus / part / "000000.png")) for part in ("images", "masks"))
    assert (image[border] == 0).all() and (mask[border] == 255).all() and (mask[~border] == 0).all()


def test_options_of_the_other_scene_are_rejected():
    with pytest.raises(InputError, match="--pull-mm"):
        PhantomConfig(scene="tube", pull_mm=3.0)
    with pytest.raises(InputError, match="--scene sinus: expected no --camera"):
        PhantomConfig(scene="sinus", camera="inspect")
