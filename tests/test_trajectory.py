"""Errors of camera paths: closed forms, a slow alignment, what must not matter, degenerate paths."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from scipy.optimize import least_squares
from scipy.spatial.transform import Rotation

from endoprior.evaluation.scorers.camera_path import align_paths, trajectory_errors

AROUND_Y = [0.0, 1.0, 0.0]


def poses(centers: np.ndarray, turns_deg: np.ndarray | None = None) -> np.ndarray:
    """(T, 4, 4) camera-to-world from (T, 3) centers and rotation vectors, degrees."""
    out = np.tile(np.eye(4), (len(centers), 1, 1))
    out[:, :3, 3] = centers
    if turns_deg is not None:
        out[:, :3, :3] = Rotation.from_rotvec(np.asarray(turns_deg), degrees=True).as_matrix()
    return out


def random_path(seed: int = 0, frames: int = 12) -> np.ndarray:
    rng = np.random.default_rng(seed)
    return poses(np.cumsum(rng.normal(0, 3, (frames, 3)), 0), np.cumsum(rng.normal(0, 4, (frames, 3)), 0))


def moved(path: np.ndarray, seed: int = 1, scale: float = 1.0) -> np.ndarray:
    """The same path in other world axes and in another unit of length."""
    rng = np.random.default_rng(seed)
    world = poses(rng.normal(0, 50, (1, 3)), rng.normal(0, 90, (1, 3)))[0]
    out = world @ path
    out[:, :3, 3] *= scale
    return out


def noisy(path: np.ndarray, seed: int = 2, mm: float = 0.5, degrees: float = 1.0) -> np.ndarray:
    rng = np.random.default_rng(seed)
    return path @ poses(rng.normal(0, mm, (len(path), 3)), rng.normal(0, degrees, (len(path), 3)))


SQUARE = np.array([[10.0, 10, 0], [-10, 10, 0], [-10, -10, 0], [10, -10, 0]])


@pytest.mark.parametrize("with_scale", [False, True])
def test_a_path_in_other_axes_has_no_error(with_scale):
    errors = trajectory_errors(moved(random_path()), random_path(), with_scale)
    np.testing.assert_allclose(errors, [0, 0, 0, 0, 1], atol=1e-5)


def test_a_square_of_twice_the_size():
    """Rigid: each corner is 10 sqrt 2 from its true place, each side 20 mm too long. Scaled: nothing is wrong."""
    rigid = trajectory_errors(poses(2 * SQUARE), poses(SQUARE), False)
    np.testing.assert_allclose(rigid, [np.sqrt(200), 20, 0, 0, 1], atol=1e-6)
    np.testing.assert_allclose(trajectory_errors(poses(2 * SQUARE), poses(SQUARE), True), [0, 0, 0, 0, 0.5], atol=1e-6)


def test_one_side_of_three_in_relative_error():
    """The third center of a straight path is 3 mm too far: 3 mm in one of three steps, too short by 3 in the next."""
    true = poses(np.array([[0.0, 0, 0], [10, 0, 0], [20, 0, 0], [30, 0, 0]]))
    wrong = true.copy()
    wrong[2, 0, 3] += 3
    errors = trajectory_errors(wrong, true, False)
    assert errors.rpe_mm == pytest.approx(np.sqrt((0 + 9 + 9) / 3))
    # The offset of the mean, 0.75, is aligned away.
    assert errors.ate_mm == pytest.approx(np.sqrt((3 * 0.75**2 + 2.25**2) / 4))
    assert errors.rpe_deg == pytest.approx(0, abs=1e-9)


def test_a_turn_in_one_frame_is_counted_in_two_steps():
    """The camera of one of four frames is turned by 6 degrees: by 1.5 in the mean, twice 6 degrees in three steps."""
    turns = np.zeros((4, 3))
    turns[2] = 6.0 * np.array(AROUND_Y)
    errors = trajectory_errors(poses(SQUARE, turns), poses(SQUARE), False)
    assert errors.rotation_error_deg == pytest.approx(1.5, abs=1e-4)
    assert errors.rpe_deg == pytest.approx(4.0)
    assert errors.ate_mm < 1e-6


def test_the_mean_angle_is_not_a_root_mean_square():
    turns = np.array([[0, 0, 0], [0, 1, 0], [0, 4, 0]], np.float64)  # steps of 1 and 3 degrees
    still = poses(np.zeros((3, 3)))
    assert trajectory_errors(poses(np.zeros((3, 3)), turns), still, False).rpe_deg == pytest.approx(2.0)


def test_known_noise_of_rotations():
    """Independent turns of sigma per axis: a mean angle of sigma sqrt(8 / pi), and sqrt 2 times that per step."""
    rng = np.random.default_rng(0)
    true = random_path(frames=4000)
    estimated = true @ poses(np.zeros((4000, 3)), rng.normal(0, 0.5, (4000, 3)))
    errors = trajectory_errors(estimated, true, False)
    assert errors.rotation_error_deg == pytest.approx(0.5 * np.sqrt(8 / np.pi), rel=0.02)
    assert errors.rpe_deg == pytest.approx(np.sqrt(2) * 0.5 * np.sqrt(8 / np.pi), rel=0.02)


def test_tiny_turns_are_not_lost_in_rounding():
    turns = np.array([[0, 0, 0], [0, 1e-6, 0]])
    assert trajectory_errors(poses(np.zeros((2, 3)), turns), poses(np.zeros((2, 3))), False).rpe_deg == pytest.approx(
        1e-6, rel=1e-6
    )


@pytest.mark.parametrize("with_scale", [False, True])
def test_alignment_is_the_least_squares_one(with_scale):
    true, estimated = random_path(0), moved(noisy(random_path(0)), 7, 0.4 if with_scale else 1.0)

    def residuals(x):
        scale = np.exp(x[6]) if with_scale else 1.0
        placed = [scale * Rotation.from_rotvec(x[:3]).as_matrix() @ p[:3, 3] + x[3:6] for p in estimated]
        return np.concatenate([a - q[:3, 3] for a, q in zip(placed, true, strict=True)])

    starts = Rotation.random(6, random_state=0).as_rotvec()
    slow = min((least_squares(residuals, [*r, 0, 0, 0, 0], x_scale="jac") for r in starts), key=lambda fit: fit.cost)
    errors = trajectory_errors(estimated, true, with_scale)
    assert errors.ate_mm == pytest.approx(np.sqrt(2 * slow.cost / len(true)), rel=1e-6)
    assert errors.scale == pytest.approx(np.exp(slow.x[6]) if with_scale else 1.0, rel=1e-5)


def test_relative_errors_by_a_slow_loop():
    true, estimated = random_path(), noisy(random_path())
    mm, degrees = [], []
    for i in range(len(true) - 1):
        step = np.linalg.inv(estimated[i]) @ estimated[i + 1]
        true_step = np.linalg.inv(true[i]) @ true[i + 1]
        error = np.linalg.inv(true_step) @ step
        mm.append(np.linalg.norm(error[:3, 3]))
        degrees.append(np.rad2deg(Rotation.from_matrix(error[:3, :3]).magnitude()))
    errors = trajectory_errors(estimated, true, False)
    assert errors.rpe_mm == pytest.approx(np.sqrt(np.mean(np.square(mm))))
    assert errors.rpe_deg == pytest.approx(np.mean(degrees))


@given(st.integers(0, 10**6), st.integers(3, 12), st.floats(1e-3, 1e3), st.booleans())
def test_axes_of_the_world_do_not_matter_and_with_scale_no_unit(seed, frames, factor, with_scale):
    true = random_path(seed, frames)
    estimated = noisy(true, seed + 1)
    wanted = trajectory_errors(estimated, true, with_scale)[:4]
    there = moved(estimated, seed + 2, factor if with_scale else 1.0)
    np.testing.assert_allclose(trajectory_errors(there, moved(true, seed + 3), with_scale)[:4], wanted, atol=1e-4)


# --- degenerate paths


@pytest.mark.parametrize("with_scale", [False, True])
def test_two_cameras_at_rest_are_aligned_by_their_axes(with_scale):
    still = poses(np.full((5, 3), 20.0), np.tile([0, 30.0, 0], (5, 1)))
    np.testing.assert_allclose(trajectory_errors(moved(still), still, with_scale), [0, 0, 0, 0, 1], atol=1e-6)


@pytest.mark.parametrize("with_scale", [False, True])
@pytest.mark.parametrize("estimated_moves", [False, True])
def test_where_one_camera_is_at_rest_the_extent_of_the_other_is_the_error(with_scale, estimated_moves):
    paths = [poses(np.zeros((4, 3))), poses(SQUARE)][:: -1 if estimated_moves else 1]
    np.testing.assert_allclose(trajectory_errors(*paths, with_scale), [np.sqrt(200), 20, 0, 0, 1], atol=1e-6)


def test_rounding_is_no_motion():
    """The mean of equal centers differs from them in the last bit."""
    at_rest = np.full((7, 3), 0.1)
    assert (at_rest != at_rest.mean(0)).any()
    errors = trajectory_errors(poses(at_rest), random_path(frames=7), True)
    aligned_by_axes = trajectory_errors(poses(np.zeros((7, 3))), random_path(frames=7), True)
    np.testing.assert_allclose(errors, aligned_by_axes, atol=1e-9)


def test_a_scale_is_not_negative():
    """Two paths of 3 um in opposite directions: their axes, which agree, decide the rotation."""
    there = poses(np.outer([0, 1, 2, 3], [1.1e-3, 0, 0]))
    assert align_paths(poses(-1000 * there[:, :3, 3]), there, True)[0] == 0


@pytest.mark.parametrize("frames", [2, 9])
def test_the_turn_about_a_straight_path_is_that_of_the_axes(frames):
    straight = poses(np.outer(np.arange(frames), [0, 0, 1.0]), np.outer(np.arange(frames), [0, 0, 2.0]))
    errors = trajectory_errors(moved(straight), straight, False)
    np.testing.assert_allclose(errors, [0, 0, 0, 0, 1], atol=1e-4)


def test_a_mirrored_path_is_not_mirrored_back():
    true = random_path()
    mirrored = poses(true[:, :3, 3] * [1, 1, -1])
    assert np.linalg.det(align_paths(mirrored, true, True)[1]) == pytest.approx(1)
    assert trajectory_errors(mirrored, true, True).ate_mm > 0.5


def test_one_frame_has_no_relative_error():
    errors = trajectory_errors(moved(random_path(frames=1)), random_path(frames=1), True)
    assert errors.ate_mm < 1e-9 and errors.rotation_error_deg < 1e-6 and errors.scale == 1
    assert np.isnan(errors.rpe_mm) and np.isnan(errors.rpe_deg)
