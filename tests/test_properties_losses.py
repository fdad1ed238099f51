"""The objective on generated pictures and points: finite, zero where it should be, equal to its definition."""

from __future__ import annotations

from unittest import mock

import numpy as np
import pytest
import torch
from frame_strategies import SEEDS, SIDES, masks, pictures
from hypothesis import given
from hypothesis import strategies as st
from hypothesis_profiles import examples

from endoprior.core.config import TemporalConfig
from endoprior.training import local_motion, losses, temporal
from endoprior.training.local_motion import affinity_numba, local_motion_numba, neighbors_numba
from endoprior.training.losses import supervised_losses_numba as supervised_losses


@st.composite
def comparisons(draw):
    """Rendered color and depth, and what they are compared with: empty masks, no depth, nothing drawn included."""
    height, width = draw(SIDES), draw(SIDES)
    rng = np.random.default_rng(draw(SEEDS))
    color = rng.uniform(-0.2, 1.4, (height, width, 3)).astype(np.float32)
    depth = rng.uniform(30, 90, (height, width)).astype(np.float32) * (rng.random((height, width)) < 0.8)
    kind = draw(st.sampled_from(["usual", "nothing drawn", "flat", "thin"]))
    if kind == "nothing drawn":
        color[:], depth[:] = 0, 0
    elif kind == "flat":
        color[:], depth[:] = 0.5, 50
    elif kind == "thin":  # the least the renderer can give: one Gaussian at ALPHA_MIN behind a nearly full pixel
        depth[:] = 1e-7
    target = draw(pictures(height, width))
    mask, known = draw(masks(height, width)), draw(masks(height, width))
    inverse = np.where(known, 1 / rng.uniform(0.2, 1e9, (height, width)), 0).astype(np.float32)
    return [torch.from_numpy(a) for a in (color, depth, target, inverse, mask, known & mask)]


@given(comparisons(), st.sampled_from([(1.0, 1.0, 0.03, 0.0), (1.0, 0.0, 0.0, 0.5), (0.0, 1.0, 1.0, 1.0)]))
def test_supervised_terms_are_finite_and_those_of_the_definition(made, weights):
    color, depth, target, inverse, mask, measured = made
    color.requires_grad_(), depth.requires_grad_()
    terms = supervised_losses(color, depth, target, inverse, mask, measured, weights)
    terms.sum().backward()
    assert torch.isfinite(terms).all() and (terms >= 0).all()
    assert torch.isfinite(color.grad).all() and torch.isfinite(depth.grad).all()
    c, d = (t.detach().double().requires_grad_() for t in (color, depth))
    shown = losses.inverse_depth(d)
    want = torch.stack([
        weights[0] * losses.color_l1(c, target.double() / 255, mask),
        weights[1] * losses.inverse_depth_l1(shown, inverse.double(), measured),
        weights[2] * (losses.total_variation(c) + losses.total_variation(shown)),
        weights[3] * losses.edge_l1(c, target.double() / 255, mask),
    ])  # fmt: skip
    want.sum().backward()
    # Each row is summed in float32.
    np.testing.assert_allclose(terms.detach(), want.detach(), rtol=1e-5, atol=1e-9)
    if not mask.any():
        assert terms[0] == 0
    if not measured.any():
        assert terms[1] == 0
    if c.grad is not None:  # signs flip where color and target agree to the last bit
        assert ((color.grad - c.grad).abs() <= 1e-6 + 1e-5 * c.grad.abs()).double().mean() > 0.9


@given(comparisons())
def test_a_perfect_picture_of_one_color_costs_nothing(made):
    _, _, target, _, mask, _ = made
    color = torch.full(target.shape, 0.2)
    depth = torch.full(mask.shape, 50.0)
    same = torch.full(target.shape, 51, dtype=torch.uint8)
    terms = supervised_losses(color, depth, same, 1 / depth, mask, mask, (1.0, 1.0, 0.03, 0.5))
    assert terms.abs().max() < 1e-6


def with_torch(now, before, indices, pair_weights, smooth_l1):
    """The PyTorch implementation, given the arrays that the Numba one takes."""
    indices, pair_weights = torch.as_tensor(indices), torch.as_tensor(pair_weights)
    return local_motion.local_motion(now, before, indices, pair_weights, smooth_l1)


@st.composite
def clouds(draw):
    """(P, 3) points: spread, in a line, on a grid, or all at one place; P from 2."""
    rng, num = np.random.default_rng(draw(SEEDS)), draw(st.integers(2, 60))
    kind, size = draw(st.sampled_from(["spread", "line", "grid", "one place"])), draw(st.sampled_from([1e-6, 1.0, 1e6]))
    points = rng.normal(size=(num, 3))
    if kind == "line":
        points[:, 1:] = 0
    elif kind == "grid":
        points = np.rint(points)
    elif kind == "one place":
        points[:] = points[0]
    return points * size


@examples(30)
@given(clouds(), st.integers(1, 8), st.booleans(), SEEDS)
def test_the_temporal_term_is_finite_and_that_of_the_definition(points, k, smooth_l1, seed):
    if k >= len(points):
        with pytest.raises(ValueError, match="k must be in"):
            neighbors_numba(points, k)
        return
    indices, distances = neighbors_numba(points, k)
    weights = np.random.default_rng(seed).random(len(points))
    pair_weights = affinity_numba(distances, indices, weights)
    assert np.isfinite(pair_weights).all() and (pair_weights >= 1e-8).all()
    scale = np.abs(points).max()
    moved = points + np.random.default_rng(seed).normal(size=points.shape) * 0.1 * scale
    results = []
    for function in (local_motion_numba, with_torch):
        now, before = (torch.tensor(p).requires_grad_() for p in (moved, points))
        terms = function(now, before, indices, pair_weights, smooth_l1)
        sum(terms).backward()
        assert all(torch.isfinite(t) and t >= 0 for t in terms)
        assert torch.isfinite(now.grad).all() and torch.isfinite(before.grad).all()
        results.append([*(t.detach().numpy() for t in terms), now.grad.numpy(), before.grad.numpy()])
    for got, want in zip(*results, strict=True):
        np.testing.assert_allclose(got, want, rtol=1e-6, atol=1e-9)


@given(clouds(), SEEDS)
def test_what_moves_as_one_costs_nothing(points, seed):
    """Eq. (11): a common translation has no displacement part but its floor, a rigid motion no distance part."""
    k = min(4, len(points) - 1)
    indices, distances = neighbors_numba(points, k)
    pair_weights = affinity_numba(distances, indices, np.ones(len(points)))
    size = np.abs(points).max()
    shift = np.random.default_rng(seed).normal(size=3) * size
    turn = np.linalg.qr(np.random.default_rng(seed).normal(size=(3, 3)))[0]
    before = torch.tensor(points)
    displacement, distance = local_motion_numba(before + torch.tensor(shift), before, indices, pair_weights)
    assert displacement == pytest.approx(1e-4, abs=1e-6 + 1e-9 * size)
    turned = torch.tensor(points @ turn.T + shift)
    assert distance < 1e-9 * (1 + size)
    assert local_motion_numba(turned, before, indices, pair_weights)[1] < 1e-9 * (1 + size)


@given(SEEDS, st.integers(0, 300), st.integers(1, 100), st.sampled_from([0.0, -300.0, 30.0]))
def test_chosen_gaussians_are_distinct_and_have_weight(seed, num, count, exponent):
    rng = np.random.default_rng(seed)
    weights = rng.random(num) * (rng.random(num) < 0.7) * 10.0**exponent
    chosen = temporal.systematic_sample(weights, count)
    assert len(chosen) <= count or len(chosen) == 0
    assert (np.diff(chosen) > 0).all() and (weights[chosen] > 0).all()
    assert len(chosen) > 0 or not (weights > 0).any()


@given(SEEDS, st.integers(0, 300), st.sampled_from([1e-5, 0.08, 10.0]), st.booleans())
def test_motion_weights_are_in_0_to_1_and_rise_with_the_score(seed, num, temperature, adaptive):
    cfg = TemporalConfig(gradient="both")
    score = np.sort(np.random.default_rng(seed).random(num)).astype(np.float32)
    with mock.patch.object(temporal, "MOTION_TEMPERATURE", temperature):
        weights = temporal.kept_motion_weight(score, adaptive)
        chosen, taken = temporal.choose(score, np.ones(num, bool), cfg, adaptive)
    assert ((weights >= 0) & (weights <= 1)).all() and (np.diff(weights) >= 0).all()
    assert len(chosen) == len(taken) and (len(chosen) == 0 or len(chosen) >= cfg.min_points)
