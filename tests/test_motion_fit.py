"""Splines fitted to tracks, as smooth as the noise asks; what they leave across the ray stays with its frame."""

import numpy as np
import pytest

from endoprior.core.config_deformation import BasisConfig
from endoprior.initialization.motion_fit import STIFFNESS, best_stiffness, fit_motion, solver
from endoprior.model.basis import spline_weights

CFG = BasisConfig(num_bases=20)
TIMES = [i / 40 for i in range(40) if i % 8]  # frames are held out
WEIGHTS = np.stack([spline_weights(t, 20) for t in TIMES])
RAY = np.array([0.6, 0.0, 0.8])
ACROSS = np.array([0.8, 0.0, -0.6])


def moved(offsets, num=30):
    """(T, N) motion along the ray and (T, N) across it that the fit gives to (T, N, 3) offsets, at the frames."""
    coefficients, at_frames = fit_motion(offsets, np.tile(RAY, (num, 1)), TIMES, CFG)
    fitted = np.einsum("tb,nbc->tnc", WEIGHTS, coefficients) + at_frames.transpose(1, 0, 2)
    return fitted @ RAY, fitted @ ACROSS


def test_offsets_in_the_span_of_few_slow_functions_are_reproduced():
    slow = np.outer(np.sin(2 * np.pi * np.array(TIMES)), np.arange(30))
    along, across = moved(slow[..., None] * (RAY + 2 * ACROSS))
    np.testing.assert_allclose(along, slow, atol=0.02 * 29)
    np.testing.assert_allclose(across, 2 * slow, atol=1e-4)


def test_noise_of_depth_does_not_move_what_rests():
    noise = np.random.default_rng(0).normal(size=(len(TIMES), 30, 1))
    along, across = moved(noise * RAY)
    assert np.sqrt((along**2).mean()) < 0.3  # that of a straight line is 0.24; as it is, 0.75
    np.testing.assert_allclose(across, 0, atol=1e-5)


def test_tissue_that_moves_keeps_its_motion_and_loses_noise():
    motion = np.outer(np.sin(2 * np.pi * np.array(TIMES)), np.linspace(1, 3, 30))
    noise = np.random.default_rng(1).normal(0, 0.3, motion.shape)
    along, _ = moved((motion + noise)[..., None] * RAY)
    plain = WEIGHTS @ solver(WEIGHTS, TIMES, 0.0) @ (motion + noise)
    error, before = (np.sqrt(((values - motion) ** 2).mean()) for values in (along, plain))
    assert error < 0.7 * before


@pytest.mark.parametrize("noise", [0.01, 1.0])
def test_stiffness_has_the_least_generalized_cross_validation_error(noise):
    rng = np.random.default_rng(2)
    values = np.sin(6 * np.pi * np.array(TIMES))[:, None] + rng.normal(0, noise, (len(TIMES), 7))
    errors = []
    for stiffness in STIFFNESS:
        hat = WEIGHTS @ solver(WEIGHTS, TIMES, stiffness)
        residual = sum(((values[:, n] - hat @ values[:, n]) ** 2).sum() for n in range(7))
        errors.append(residual / (len(TIMES) - sum(hat[t, t] for t in range(len(TIMES)))) ** 2)
    assert best_stiffness(values, WEIGHTS, TIMES) == STIFFNESS[int(np.argmin(errors))]


def test_more_noise_asks_for_more_stiffness():
    motion, rng = np.sin(6 * np.pi * np.array(TIMES))[:, None], np.random.default_rng(3)
    found = [best_stiffness(motion + rng.normal(0, s, (len(TIMES), 50)), WEIGHTS, TIMES) for s in (0.01, 0.5, 20)]
    assert found == sorted(found) and found[0] < found[1] < found[2]


def test_a_straight_line_does_not_bend():
    """Frames are not equally far apart: a penalty on differences by index would bend it."""
    line = np.array(TIMES)[:, None]
    plain, stiff = (WEIGHTS @ solver(WEIGHTS, TIMES, s) @ line for s in (0.0, 100.0))
    np.testing.assert_allclose(stiff, plain, atol=0.01)


@pytest.mark.parametrize("count", [1, 2, 3])
def test_few_frames_are_fitted(count):
    cfg, times = BasisConfig(num_bases=4), [i / count for i in range(count)]
    offsets = np.ones((count, 2, 3)) * np.arange(count)[:, None, None]
    coefficients, at_frames = fit_motion(offsets, np.tile(RAY, (2, 1)), times, cfg)
    assert coefficients.shape == (2, 4, 3) and at_frames.shape == (2, count, 3)
    assert np.isfinite(coefficients).all() and np.isfinite(at_frames).all()


def test_a_shake_stays_in_the_frames_that_show_it():
    """What no smooth curve holds is at its frame, and the curve between is as if it had not been."""
    shake = np.random.default_rng(4).normal(size=(len(TIMES), 1, 1)) * np.ones((1, 30, 1))
    coefficients, at_frames = fit_motion(shake * ACROSS, np.tile(RAY, (30, 1)), TIMES, CFG)
    curve = np.einsum("tb,nbc->tnc", WEIGHTS, coefficients) @ ACROSS
    assert np.sqrt((curve**2).mean()) < 0.4  # of a shake of 1
    np.testing.assert_allclose(curve + (at_frames @ ACROSS).T, shake[..., 0], atol=1e-5)
    np.testing.assert_allclose(at_frames @ RAY, 0, atol=1e-5)
