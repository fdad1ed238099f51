"""Camera poses that are trained with the scene: the transform, its gradient, what undoes a step, and what it finds."""

from __future__ import annotations

from copy import copy
from dataclasses import replace
from types import SimpleNamespace

import numpy as np
import pytest
import torch
from export_scenes import random_splats
from scipy.linalg import expm
from scipy.spatial.transform import Rotation
from tiny_training import tiny_config

from endoprior import render
from endoprior.core.config import Config
from endoprior.core.config_poses import PoseConfig
from endoprior.core.types import Camera, Splats
from endoprior.data import load_sequence
from endoprior.phantom import PhantomConfig, write_phantom
from endoprior.runs.checkpoint import load_checkpoint, save_checkpoint
from endoprior.training.gaussian_trainer import GaussianTrainer
from endoprior.training.pose_check import FollowedCorners, corner_error_px
from endoprior.training.pose_refinement import (
    PoseRefinement,
    PoseState,
    moved,
    refined_cameras,
    rigid,
    rotation,
    smoothness,
)

BACKENDS = ("reference", "numba")


def camera(turn: float = 0.0, width: int = 64) -> Camera:
    pose = np.eye(4)
    pose[:3, :3] = Rotation.from_rotvec([0.1, turn, -0.05]).as_matrix()
    pose[:3, 3] = (4.0, -2.0, 5.0)
    return Camera(width, 48, 70.0, 72.0, 30.0, 26.0, pose)


def in_the_middle(splats: Splats) -> Splats:
    """Well inside the image and not quite opaque: where rasterizers clamp nothing, their gradient is exact."""
    means = splats.means * torch.tensor([0.25, 0.2, 0.5]) + torch.tensor([0.0, 2.0, 35.0])
    return replace(splats, means=means, opacities=splats.opacities.clamp(0.2, 0.8), scales=splats.scales.clamp(0.5, 2))


def test_a_rotation_is_the_exponential_of_its_vector():
    rng = np.random.default_rng(0)
    for scale in (0.0, 1e-12, 1e-9, 1e-7, 1e-4, 0.1, 1.0, 3.0):
        x, y, z = vector = scale * rng.normal(size=3)
        cross = np.array([[0, -z, y], [z, 0, -x], [-y, x, 0]])
        np.testing.assert_allclose(rotation(torch.from_numpy(vector)).numpy(), expm(cross), atol=1e-12 + 1e-9 * scale)


def test_the_gradient_at_rest_is_finite_and_right():
    vector = torch.zeros(3, dtype=torch.float64, requires_grad=True)
    torch.autograd.gradcheck(rotation, (vector,))
    torch.autograd.gradcheck(rigid, (torch.tensor([1e-3, -0.2, 0.1, 1, 2, 3.0], dtype=torch.float64).requires_grad_(),))


@pytest.mark.parametrize("backend", BACKENDS)
def test_moving_the_gaussians_is_moving_the_camera(backend):
    splats, view = random_splats(degree=0), camera()
    twist = torch.tensor([0.02, -0.05, 0.03, 1.0, -2.0, 0.5], dtype=torch.float64)
    turned = replace(view, world_to_camera=rigid(twist).numpy() @ view.world_to_camera)
    rasterize, black = render.load(backend), torch.zeros(3)
    want, got = (
        rasterize(splats, turned, background=black),
        rasterize(moved(splats, view, twist), view, background=black),
    )
    assert (want.color - got.color).abs().max() < 2e-3 and want.alpha.max() > 0.5
    assert (want.depth - got.depth).abs().max() < 0.05


def loss_of(twist: torch.Tensor, splats: Splats, backend: str) -> torch.Tensor:
    view, target = camera(), torch.rand((48, 64, 3), generator=torch.Generator().manual_seed(0))
    drawn, black = moved(splats, view, twist), torch.zeros(3).to(splats.means)
    out = render.load(backend)(drawn, view, background=black, depth_grad_to_means=True)
    return ((out.color - target) ** 2).double().sum() + 1e-4 * (out.depth.double() ** 2).sum()


def test_the_gradient_of_the_pose_equals_central_differences():
    """In float64, with steps so small that no pixel enters or leaves a footprint; other backends equal it."""
    splats = in_the_middle(random_splats(num=12, degree=0))
    exact = Splats(**{name: value.double() for name, value in splats.tensors.items()})
    twist = torch.tensor([0.01, -0.02, 0.015, 0.3, -0.2, 0.1], dtype=torch.float64, requires_grad=True)
    loss_of(twist, exact, "reference").backward()
    gradient = twist.grad.clone()
    for k in range(6):
        step = torch.zeros(6, dtype=torch.float64)
        step[k] = 1e-7
        with torch.no_grad():
            slope = (loss_of(twist + step, exact, "reference") - loss_of(twist - step, exact, "reference")) / 2e-7
        assert float(gradient[k]) == pytest.approx(float(slope), rel=1e-3, abs=1e-3)
    twist.grad = None
    loss_of(twist, splats, "numba").backward()
    torch.testing.assert_close(twist.grad, gradient, rtol=5e-3, atol=0.05)


def test_a_held_out_frame_lies_between_its_neighbors():
    cameras = [camera(0.01 * i) for i in range(5)]
    twists = np.zeros((4, 6))
    twists[:, 0], twists[:, 5] = [0.01, 0.02, 0.04, 0.05], [1, 2, 4, 5]
    found = refined_cameras(cameras, [0, 1, 3, 4], twists)
    for index, (turn, shift) in enumerate([(0.01, 1), (0.02, 2), (0.03, 3), (0.04, 4), (0.05, 5)]):
        want = (
            rigid(torch.tensor([turn, 0, 0, 0, 0, shift], dtype=torch.float64)).numpy() @ cameras[index].world_to_camera
        )
        np.testing.assert_allclose(found[index].world_to_camera, want, atol=1e-12)


def corners_between(first: Camera, second: Camera) -> FollowedCorners:
    rng = np.random.default_rng(0)
    points = rng.uniform([-10, -10, 50], [10, 10, 70], (40, 3))
    seen = []
    for view in (first, second):
        at = points @ view.world_to_camera[:3, :3].T + view.world_to_camera[:3, 3]
        seen.append((at[:, :2] / at[:, 2:] * (view.fx, view.fy) + (view.cx, view.cy), at[:, 2]))
    return FollowedCorners(0, seen[0][0], seen[0][1], seen[1][0])


def test_the_error_of_corners_is_zero_at_the_true_poses_only():
    first, second = camera(), camera(0.05)
    corners = corners_between(first, second)
    assert corner_error_px([corners], [first, second]) == pytest.approx(0, abs=1e-9)
    off = replace(
        second, world_to_camera=rigid(torch.tensor([0, 0.01, 0, 0, 0, 0.0])).double().numpy() @ second.world_to_camera
    )
    assert corner_error_px([corners], [first, off]) == pytest.approx(0.7, rel=0.2)
    assert np.isnan(corner_error_px([], [first, second]))


@pytest.fixture
def refinement(monkeypatch):
    """Two frames whose second pose is wrong by a turn, with corners that know the true one."""
    first, true = camera(), camera(0.05)
    corners = corners_between(first, true)
    monkeypatch.setattr("endoprior.training.pose_refinement.follow_corners", lambda frames: [corners])
    cfg = replace(Config(), poses=PoseConfig(refine="always", start_iteration=1, check_every=4))
    given_cameras = [first, camera(0.055)]
    return PoseRefinement(given_cameras, SimpleNamespace(indices=[0, 1]), cfg)


def test_steps_that_held_out_corners_confirm_stay(refinement):
    state = PoseState.at_start(2)
    gradient = torch.tensor([0, 1.0, 0, 0, 0, 0], dtype=torch.float64)  # descends: the turn shrinks
    for iteration in range(1, 9):
        refinement.step(state, 1, gradient, iteration)
    assert state.twists[1, 1] < -5e-4 and torch.equal(state.accepted, state.twists)
    assert refinement.error_px(state.twists) < refinement.error_px(torch.zeros(2, 6, dtype=torch.float64))


def test_steps_that_held_out_corners_speak_against_are_undone(refinement):
    state = PoseState.at_start(2)
    for iteration in range(1, 4):
        refinement.step(state, 1, torch.tensor([0, -1.0, 0, 0, 0, 0], dtype=torch.float64), iteration)
    assert state.twists[1, 1] > 2e-4
    refinement.step(state, 1, torch.tensor([0, -1.0, 0, 0, 0, 0], dtype=torch.float64), 4)
    assert (state.twists == 0).all() and (state.first == 0).all() and (state.steps == 0).all()


@pytest.fixture(scope="module")
def moving(tmp_path_factory):
    """A phantom whose camera moves."""
    folder = tmp_path_factory.mktemp("moving") / "data"
    write_phantom(folder, PhantomConfig(frames=10, width=96, height=80, camera="inspect", side_views=False))
    return load_sequence(folder)


def refining(mode: str) -> Config:
    cfg = tiny_config("basis")
    return replace(cfg, poses=PoseConfig(refine=mode, start_iteration=2, check_every=5, worse=1.0))


@pytest.mark.parametrize(
    ("mode", "source", "refines"),
    [
        ("never", "own", False),
        ("estimated", "given", False),
        ("estimated", "our own tracks", True),
        ("always", "given", True),
    ],
)
def test_whose_poses_are_refined(moving, make_tiny_sequence, mode, source, refines):
    sequence = copy(moving)
    sequence.sources = {"poses": source}
    trainer = GaussianTrainer(sequence, refining(mode))
    assert (trainer.step_once.poses is not None) == refines
    assert GaussianTrainer(load_sequence(make_tiny_sequence()), refining("always")).step_once.poses is None, (
        "a static camera"
    )


def test_refined_poses_are_those_of_the_scene_and_resume_bit_for_bit(moving, tmp_path):
    whole = GaussianTrainer(moving, refining("always"))
    whole.start()
    while not whole.finished:
        whole.step()
        if whole.progress()[0] == 13:
            save_checkpoint(whole, tmp_path / "state", "0")
    scene, twists = whole.scene(), whole.state.poses.twists
    assert (whole.state.poses.steps > 0).any()
    changed = [
        not np.array_equal(a.world_to_camera, b.world_to_camera)
        for a, b in zip(scene.cameras, whole.cameras, strict=True)
    ]
    assert any(changed) == bool(twists.any())
    again = GaussianTrainer(moving, refining("always"))
    load_checkpoint(again, tmp_path / "state", "0")
    while not again.finished:
        again.step()
    assert torch.equal(again.state.poses.twists, twists)
    assert torch.equal(again.state.gaussians["means"], whole.state.gaussians["means"])


def test_a_single_training_frame_is_not_pulled():
    twist = torch.ones(6, dtype=torch.float64)
    assert smoothness(twist[None], 0, twist, PoseConfig()) == 0
    neighbors = torch.zeros((3, 6), dtype=torch.float64)
    assert smoothness(neighbors, 1, twist, PoseConfig()) > 0


def test_a_gradient_that_is_not_finite_reaches_no_pose(refinement):
    state = PoseState.at_start(2)
    refinement.step(state, 1, torch.full((6,), torch.nan, dtype=torch.float64), 1)
    assert (state.twists == 0).all() and (state.first == 0).all()
