"""`endoprior phantom --scene tube`: the truth of path, depth and tracks agrees with itself, and the lamp with 1/z^2."""

import cv2
import numpy as np
import pytest

from endoprior.core.checks import InputError
from endoprior.data import load_sequence
from endoprior.phantom import PhantomConfig, write_phantom

SMALL = PhantomConfig(scene="tube", frames=8, width=96, height=80, tracks=200)


@pytest.fixture(scope="module")
def tube(tmp_path_factory):
    folder = tmp_path_factory.mktemp("tube") / "data"
    write_phantom(folder, SMALL)
    return folder


def test_true_tracks_lie_on_the_true_depth_and_on_one_rigid_wall(tube):
    tracks, poses = np.load(tube / "truth/tracks.npz"), np.load(tube / "truth/camera_to_world.npy")
    points, visible = tracks["points"].astype(np.float64), tracks["visible"]
    assert visible.sum() > 500
    world = np.einsum("tij,tpj->tpi", poses[:, :3, :3], points) + poses[:, None, :3, 3]
    assert np.abs(world - world[:1]).max() < 1e-3
    for frame in range(SMALL.frames):
        depth = np.load(tube / f"truth/depth/{frame:06d}.npy")
        seen = points[frame][visible[frame]]
        x, y = (SMALL.focal * seen[:, k] / seen[:, 2] + SMALL.center[k] for k in (0, 1))
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


def test_options_of_the_other_scene_are_rejected():
    with pytest.raises(InputError, match="--pull-mm"):
        PhantomConfig(scene="tube", pull_mm=3.0)
