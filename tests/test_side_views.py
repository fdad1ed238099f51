"""Truth from other sides: where the cameras are, what they keep, and how a scene is scored from there."""

import json
from types import SimpleNamespace

import cv2
import numpy as np
import pytest
import torch

from endoprior.core.checks import InputError
from endoprior.core.geometry import back_project, bilinear, project
from endoprior.core.types import Camera, RenderedView
from endoprior.data import load_sequence
from endoprior.evaluation.context import Evaluation, EvaluationContext, SceneFrames
from endoprior.evaluation.scorers import other_views
from endoprior.phantom import PhantomConfig, write_phantom
from endoprior.phantom.views import side_cameras

NAMES = {"left20", "left10", "right10", "right20", "aside15"}


@pytest.fixture(scope="module")
def folder(tmp_path_factory):
    """A phantom whose frame 1 is a test frame."""
    out = tmp_path_factory.mktemp("phantom") / "sequence"
    write_phantom(out, PhantomConfig(frames=4, width=160, height=128))
    return out


def test_cameras_turn_about_the_pivot_and_look_at_it():
    for name, eye in side_cameras(70.0).items():
        pivot = eye.to_camera(np.array([0.0, 0.0, 70.0]))
        assert np.allclose(pivot, (-15, 0, 70) if name == "aside15" else (0, 0, 70))
        assert np.allclose(eye.world_to_camera @ (1.0, 2.0, 60.0, 1.0), [*eye.to_camera(np.array([1.0, 2.0, 60.0])), 1])
        assert (eye.center[0] > 0) == (name in ("right10", "right20", "aside15"))
    right = side_cameras(70.0)["right20"]
    assert np.allclose(right.center, (70 * np.sin(np.deg2rad(20)), 0, 70 * (1 - np.cos(np.deg2rad(20)))))


def test_only_test_frames_have_side_views_and_they_can_be_left_out(folder, tmp_path):
    assert {path.name for path in (folder / "truth/side").iterdir() if path.is_dir()} == NAMES
    assert sorted(path.name for path in (folder / "truth/side/left20").iterdir()) == ["000001.npy", "000001.png"]
    write_phantom(tmp_path / "without", PhantomConfig(frames=2, width=48, height=40, side_views=False))
    assert not (tmp_path / "without/truth/side").exists()
    assert load_sequence(tmp_path / "without").truth.side_poses == {}


@pytest.mark.parametrize("name", sorted(NAMES))
def test_what_a_side_camera_keeps_is_what_the_endoscope_sees(folder, name):
    """Depth and color of each kept pixel agree with the endoscope's own truth of the same point."""
    sequence = load_sequence(folder)
    truth, front = sequence.truth, sequence.camera(1)
    picture, depth = truth.side(name, 1)
    y, x = np.nonzero(depth)
    pixels = np.stack([x, y], -1) + 0.5
    eye = Camera(front.width, front.height, front.fx, front.fy, front.cx, front.cy, truth.side_poses[name])
    points = back_project(pixels, depth[y, x].astype(np.float64), eye)
    where, z = project(points, front)
    assert len(x) > 0.25 * depth.size
    assert np.quantile(np.abs(bilinear(truth.depth(1).astype(np.float64), where) - z), 0.95) < 0.4
    assert sequence.frame(1).tissue_mask[where[:, 1].astype(int), where[:, 0].astype(int)].all()
    color = bilinear(truth.tissue(1).astype(np.float64), where)
    assert np.median(np.abs(picture[y, x] - color)) < 2


def scored(folder, render):
    sequence = load_sequence(folder)
    scene = SimpleNamespace(render=render)
    result = Evaluation({"split": "test"}, per_frame=[{"index": 1}])
    reconstruction = SceneFrames.__new__(SceneFrames)
    object.__setattr__(reconstruction, "scene", scene)
    other_views.score_sides(EvaluationContext(reconstruction, sequence, "test", False, None, result))
    return result.scores


def test_truth_itself_is_perfect_and_a_veil_is_counted(folder):
    truth = load_sequence(folder).truth

    def perfect(time, camera, nearer=1.0):
        name = next(n for n, pose in truth.side_poses.items() if np.allclose(pose, camera.world_to_camera))
        picture, depth = truth.side(name, 1)
        alpha = torch.ones(depth.shape)
        picture = np.clip(picture.astype(np.float32) + 0.5, 0, 255) / 255
        depth = torch.from_numpy(depth.copy())
        depth[: len(depth) // 2] *= nearer
        return RenderedView(torch.from_numpy(picture), depth, alpha)

    scores = scored(folder, perfect)
    assert scores["side_psnr"] > 50 and scores["side_psnr_20"] > 50
    assert scores["side_depth_rmse_mm"] == 0 and scores["side_veil"] == 0
    veiled = scored(folder, lambda time, camera: perfect(time, camera, nearer=0.9))
    assert 0.2 < veiled["side_veil"] < 0.8 and veiled["side_depth_rmse_mm"] > 3
    assert scored(folder, lambda time, camera: perfect(time, camera, nearer=0.96))["side_veil"] == 0


@pytest.mark.parametrize("poses", [{"left": [[1, 0], [0, 1]]}, {"left": "none"}, {"left": [[np.inf] * 4] * 4}])
def test_bad_poses_are_named(folder, tmp_path, poses):
    (tmp_path / "side").mkdir()
    (tmp_path / "side/world_to_camera.json").write_text(json.dumps(poses))
    truth = load_sequence(folder).truth
    broken = type(truth)(tmp_path, ["000000"])
    with pytest.raises(InputError, match=r"world_to_camera\.json: expected finite poses"):
        _ = broken.side_poses


def test_pictures_are_black_where_depth_is_zero(folder):
    picture = cv2.imread(str(folder / "truth/side/right10/000001.png"))
    depth = np.load(folder / "truth/side/right10/000001.npy")
    assert not picture[depth == 0].any() and picture[depth > 0].any(-1).mean() > 0.99
