"""Scores where the camera moves: world axes do not matter, the scene's own poses count, and the path is scored."""

from __future__ import annotations

import json
from dataclasses import replace

import numpy as np
import pytest
import torch
from scipy.spatial.transform import Rotation

from endoprior.core.checks import InputError
from endoprior.data import load_sequence
from endoprior.data.truth import Tracks, Truth
from endoprior.evaluation.context import Evaluation, EvaluationContext, SceneFrames
from endoprior.evaluation.scorers import camera_path
from endoprior.evaluation.scorers.tracks import (
    by_scene,
    parts_of,
    track_end_error_mm,
    track_scores,
    true_tracks,
    without_motion,
)
from endoprior.evaluation.scoring import evaluate
from endoprior.model.gaussians import Gaussians
from endoprior.model.presets import preset
from endoprior.model.scene import Scene
from endoprior.phantom import PhantomConfig, write_phantom
from endoprior.training.gaussian_trainer import GaussianTrainer

FRAMES = 10
OF_THE_PATH = ("ate_mm", "rpe_mm", "rpe_deg", "rotation_error_deg")


def transform(translation, turn_deg) -> np.ndarray:
    """(4, 4) rigid motion."""
    out = np.eye(4)
    out[:3, :3], out[:3, 3] = Rotation.from_rotvec(turn_deg, degrees=True).as_matrix(), translation
    return out


def path(seed: int = 0) -> list[np.ndarray]:
    """World-to-camera of a camera that moves by millimeters and turns by a few degrees; none is the identity."""
    rng = np.random.default_rng(seed)
    return [transform(rng.normal(0, 1.5, 3), rng.normal(0, 1.5, 3)) for _ in range(FRAMES)]


def posed(sequence, poses):
    return sequence.with_poses([replace(sequence.camera(i), world_to_camera=p) for i, p in enumerate(poses)])


def moved_world(scene, world):
    """The same scene in other world axes: Gaussians, their motion and the cameras."""
    turn = torch.from_numpy(world[:3, :3]).float()
    tensors = {name: tensor.detach().clone() for name, tensor in scene.gaussians.tensors.items()}
    tensors["means"] = tensors["means"] @ turn.T + torch.from_numpy(world[:3, 3]).float()
    quats = Rotation.from_matrix(world[:3, :3]) * Rotation.from_quat(tensors["quats"].numpy(), scalar_first=True)
    tensors["quats"] = torch.from_numpy(quats.as_quat(scalar_first=True)).float()
    tensors["motion"], tensors["frame_motion"] = tensors["motion"] @ turn.T, tensors["frame_motion"] @ turn.T
    back = np.linalg.inv(world)
    cameras = tuple(replace(camera, world_to_camera=camera.world_to_camera @ back) for camera in scene.cameras)
    return replace(scene, gaussians=Gaussians(tensors), cameras=cameras)


@pytest.fixture(scope="module")
def phantom(tmp_path_factory):
    """A phantom with side cameras, a right eye and a true path, which is that of `path()`."""
    out = tmp_path_factory.mktemp("moving") / "phantom"
    write_phantom(out, PhantomConfig(frames=FRAMES, width=96, height=80, stereo=True))
    np.save(out / "truth/camera_to_world.npy", np.linalg.inv(path()))
    return load_sequence(out)


@pytest.fixture(scope="module")
def scene(phantom):
    """Untrained Gaussians that all move alike, in the world of a camera that moves."""
    cfg = preset("default")
    cfg = replace(cfg, init=replace(cfg.init, budget=400, motion="rest"))
    trainer = GaussianTrainer(posed(phantom, path()), cfg)
    trainer.start()
    scene = trainer.scene()
    with torch.no_grad():
        scene.gaussians["motion"][:] = torch.tensor([0.4, -0.2, 0.3])
    return scene


def scores_of(scene, sequence):
    found = evaluate(scene, sequence, networks=False).scores
    return {name: value for name, value in found.items() if not name.startswith("fps")}


@pytest.fixture(scope="module")
def known(phantom, scene):
    """Every score of the scene but its speed."""
    return scores_of(scene, phantom)


# --- world axes


@pytest.mark.slow
def test_a_rigid_motion_of_the_world_changes_no_score(phantom, scene, known):
    there = scores_of(moved_world(scene, transform([30, -20, 15], [20, -50, 100])), phantom)
    groups = ("psnr_behind_tool", "side_psnr", "side_veil", "right_psnr", "track_error_mm", "depth_instability_mm")
    groups += ("flow_error_dis_adjacent", "track_error_mm_still", "track_average_jaccard_dis", "ate_mm", "rpe_deg")
    assert {*groups} <= known.keys() == there.keys()
    for name, value in known.items():
        assert there[name] == pytest.approx(value, rel=2e-3, abs=2e-3), name


def test_the_true_path_has_no_error(known):
    assert [known[name] for name in OF_THE_PATH] == pytest.approx([0] * 4, abs=1e-4)


def test_points_at_rest_are_followed_by_a_scene_at_rest(phantom, scene, monkeypatch):
    """The truth is in camera axes: a point at rest moves there as the camera does. No motion in the world is right."""
    sequence = posed(phantom, path())
    at_rest = {"motion": torch.zeros_like(scene.gaussians["motion"])}
    resting = replace(scene, gaussians=Gaussians({**scene.gaussians.tensors, **at_rest}))
    first = phantom.truth.tracks.points[0]
    world = np.linalg.inv(path()[0]) @ np.vstack([first.T, np.ones(len(first))])
    points = np.stack([(pose @ world)[:3].T for pose in path()]).astype(np.float32)
    visible = np.ones(points.shape[:2], bool)
    visible[:4, ::2] = False  # half of the points start in a later frame
    set_tracks(monkeypatch, phantom, Tracks(points, visible))
    true = true_tracks(sequence)
    for predicted in (by_scene(resting, true, sequence), without_motion(true, sequence)):
        scores = track_scores(predicted, true, parts_of(true, sequence))
        assert scores["track_error_mm"] < 1e-3 and scores["track_error_p90_px"] < 0.01
    still = without_motion(true, phantom)  # poses that do not move: now the points do
    assert track_scores(still, true, parts_of(true, phantom))["track_error_mm"] > 1

    visible[0], visible[1:-1] = True, False
    set_tracks(monkeypatch, phantom, Tracks(points, visible, paired=False))
    assert track_end_error_mm(resting, phantom) < 1e-3


def set_tracks(monkeypatch, sequence, tracks):
    monkeypatch.setattr(type(sequence.truth), "tracks", property(lambda self: tracks))


# --- the scene's poses


def test_the_poses_of_the_scene_count_and_not_those_of_the_sequence(phantom, scene, known):
    """They are estimated again in the folder, or refined in training: Gaussians lie in the world of the scene."""
    again = scores_of(scene, posed(phantom, path(seed=5)))
    assert again == known
    elsewhere = tuple(replace(c, world_to_camera=p) for c, p in zip(scene.cameras, path(seed=5), strict=True))
    other = scores_of(replace(scene, cameras=elsewhere), phantom)
    for name in ("psnr_tissue", "side_psnr", "right_psnr", "track_error_mm", "flow_error_dis", *OF_THE_PATH):
        assert other[name] != pytest.approx(known[name], rel=1e-3, abs=1e-3), name


def test_every_frame_is_rendered_from_its_own_camera(phantom, scene, monkeypatch):
    """Moved by nothing, to a side or to the right eye; never from the camera of another frame."""
    render, seen = Scene.render, []

    def recorded(self, time, camera=None):
        seen.append((round(time * FRAMES), (camera or self.camera_at(time)).world_to_camera))
        return render(self, time, camera)

    monkeypatch.setattr(Scene, "render", recorded)
    evaluate(scene, phantom, networks=False)
    right = transform([-phantom.right_eye.baseline_mm, 0, 0], [0, 0, 0])
    allowed = [np.eye(4), right, *phantom.truth.side_poses.values()]
    offsets = [(index, pose @ np.linalg.inv(path()[index])) for index, pose in seen]
    found = [[k for k, known in enumerate(allowed) if np.allclose(offset, known)] for _, offset in offsets]
    assert all(found) and {k for ks in found for k in ks} == set(range(len(allowed)))
    assert {index for index, _ in offsets} == set(range(FRAMES))


def test_a_sequence_takes_the_poses_and_keeps_its_lens(phantom):
    sequence = posed(phantom, path())
    assert posed(sequence, path()) is sequence
    for index in (0, 3):
        own, camera = phantom.frame(index), sequence.frame(index).camera
        assert np.array_equal(camera.world_to_camera, path()[index]) and camera is sequence.camera(index)
        assert (camera.fx, camera.cx, camera.width) == (own.camera.fx, own.camera.cx, own.camera.width)
        assert (sequence.frame(index).rgb_u8 == own.rgb_u8).all() and np.array_equal(
            own.camera.world_to_camera, np.eye(4)
        )
    assert sequence.truth is phantom.truth and sequence.fingerprint() == phantom.fingerprint()
    with pytest.raises(ValueError):
        posed(phantom, path()).with_poses([phantom.camera(0)])


# --- the score of the path


def with_cameras(scene, poses):
    cameras = (replace(c, world_to_camera=p) for c, p in zip(scene.cameras, poses, strict=True))
    return replace(scene, cameras=tuple(cameras))


def test_one_wrong_pose_is_counted(phantom, scene):
    poses = path()
    poses[4] = transform([0, 0, 0], [0, 3, 0]) @ poses[4]
    found = path_scores(with_cameras(scene, poses), phantom)
    assert found["rpe_deg"] == pytest.approx(2 * 3 / (FRAMES - 1), rel=1e-3)
    assert found["rotation_error_deg"] == pytest.approx(3 / FRAMES, rel=0.2)


def path_scores(scene, sequence):
    """Scores of `evaluate` by its scorer of the path alone."""
    result = Evaluation({"split": "test"})
    camera_path.compute(EvaluationContext(SceneFrames(scene, sequence), sequence, "test", False, None, result))
    return result.scores


def test_lengths_are_scaled_where_depth_is_relative_only(phantom, scene):
    poses = [pose.copy() for pose in path()]
    for pose in poses:
        pose[:3, 3] *= 4
    other = with_cameras(scene, poses)
    assert path_scores(other, phantom)["ate_mm"] > 1
    relative = path_scores(replace(other, lengths_are_relative=True), phantom)
    assert [relative[name] for name in OF_THE_PATH] == pytest.approx([0] * 4, abs=1e-4)


def test_without_a_true_path_there_is_no_such_score(tiny_sequence, scene, phantom, monkeypatch):
    monkeypatch.setattr(Truth, "camera_to_world", None)  # what has been read stays: another reading
    assert path_scores(scene, load_sequence(phantom.path)) == {}
    assert path_scores(scene, load_sequence(tiny_sequence)) == {}


# --- the file


def stored(folder, poses) -> Truth:
    np.save(folder / "camera_to_world.npy", poses)
    return Truth(folder, [str(i) for i in range(FRAMES)])


def test_the_true_path_is_read(tmp_path):
    poses = np.linalg.inv(path())
    assert np.array_equal(stored(tmp_path, poses).camera_to_world, poses)
    single = stored(tmp_path, poses.astype(np.float32)).camera_to_world
    assert single.dtype == np.float64 and np.allclose(single, poses, atol=1e-6)
    assert Truth(tmp_path / "nowhere", []).camera_to_world is None


@pytest.mark.parametrize(
    ("spoil", "words"),
    [
        (lambda p: p[1:], r"numbers of shape \(10, 4, 4\), got \(9, 4, 4\)"),
        (lambda p: p[:, :3], r"got \(10, 3, 4\)"),
        (lambda p: p[0], r"got \(4, 4\)"),
        (lambda p: p[:0], r"got \(0, 4, 4\)"),
        (lambda p: p.astype(str), "numbers of shape"),
        (lambda p: p.astype(complex), "numbers of shape"),
        (lambda p: np.where(np.arange(10)[:, None, None] == 4, np.nan, p), "finite numbers"),
        (lambda p: np.where(np.arange(4) == 3, 1e7, p), "at most 1e\\+06"),
        (lambda p: p.transpose(0, 2, 1), "last row"),
        (lambda p: p * np.array([[-1], [1], [1], [1]]), "rotations in the poses, got another matrix in row 0"),
        (lambda p: p * np.array([[2], [2], [2], [1]]), "rotations in the poses"),
    ],
)
def test_another_file_is_rejected(tmp_path, spoil, words):
    with pytest.raises(InputError, match=rf"camera_to_world\.npy: expected .*{words}") as caught:
        _ = stored(tmp_path, spoil(np.linalg.inv(path()))).camera_to_world
    assert "\n" not in str(caught.value)


def test_several_arrays_or_none_are_rejected(tmp_path):
    np.savez(tmp_path / "poses.npz", a=np.eye(4), b=np.eye(4))
    (tmp_path / "poses.npz").rename(tmp_path / "camera_to_world.npy")
    with pytest.raises(InputError, match="got several arrays"):
        _ = Truth(tmp_path, ["0"]).camera_to_world
    (tmp_path / "camera_to_world.npy").write_text(json.dumps([1]))
    with pytest.raises(InputError, match="a NumPy file"):
        _ = Truth(tmp_path, ["0"]).camera_to_world
