"""Temporal term, Eqs. (9)-(11): literal loops, invariances, gradients, sampling."""

from dataclasses import replace

import numpy as np
import pytest
import torch

from endoprior import temporal
from endoprior.config import TemporalConfig

CFG = TemporalConfig()


def points(num=40, seed=0):
    return np.random.default_rng(seed).uniform(-10, 10, (num, 3))


def loss(now, before, weights=None, cfg=CFG):
    indices, distances = temporal.neighbors(before.detach().numpy(), cfg.num_neighbors)
    weights = np.ones(len(before)) if weights is None else weights
    return temporal.local_motion_loss(now, before, indices, temporal.affinity(distances, indices, weights), cfg)


def test_motion_weight_is_half_at_the_threshold():
    assert temporal.motion_weight(np.array([0.45]), 0.45, 0.08)[0] == pytest.approx(0.5)


def test_relaxation_lowers_the_threshold_until_enough_count():
    score = np.full(1000, 0.1)
    score[:20] = 0.9
    fixed = temporal.relaxed_motion_weight(score, CFG)
    relaxed = temporal.relaxed_motion_weight(score, replace(CFG, adaptive_motion_weight=True))
    assert temporal.effective_size(relaxed) >= CFG.min_effective > temporal.effective_size(fixed)


def test_relaxation_stops_at_its_floor():
    weights = temporal.relaxed_motion_weight(np.zeros(10), replace(CFG, adaptive_motion_weight=True))
    # After eight tries: threshold 0.25, temperature 0.30.
    assert weights == pytest.approx(temporal.motion_weight(np.zeros(10), 0.25, 0.30))


def test_weights_up_to_the_least_one_are_dropped():
    assert temporal.relaxed_motion_weight(np.array([-1.0]), CFG)[0] == 0


def test_systematic_sample_takes_all_when_they_fit():
    assert temporal.systematic_sample(np.array([0, 1.0, 0, 2.0]), 5).tolist() == [1, 3]


def test_systematic_sample_follows_the_weights():
    weights = np.r_[np.full(1000, 1.0), np.full(1000, 3.0)]
    chosen = temporal.systematic_sample(weights, 400)
    assert len(chosen) == 400 and len(set(chosen)) == 400
    assert (chosen >= 1000).mean() == pytest.approx(0.75, abs=0.01)  # evenly spaced marks: off by one at most


def test_choose_needs_enough_points():
    score, eligible = np.full(200, 0.9), np.zeros(200, bool)
    eligible[:100] = True
    assert len(temporal.choose(score, eligible, CFG)[0]) == 0  # 100 < 128
    eligible[:150] = True
    assert len(temporal.choose(score, eligible, CFG)[0]) == 150


def test_neighbors_agree_with_a_full_search():
    p = points(60)
    indices, distances = temporal.neighbors(p, 5)
    table = np.linalg.norm(p[:, None] - p[None], axis=-1)
    np.fill_diagonal(table, np.inf)
    assert indices.tolist() == table.argsort(1)[:, :5].tolist()
    assert distances == pytest.approx(np.sort(table, 1)[:, :5])


def test_neighbors_of_coincident_points_leave_out_oneself():
    indices, _ = temporal.neighbors(np.zeros((12, 3)), 8)
    assert indices.shape == (12, 8)
    assert not (indices == np.arange(12)[:, None]).any()


def test_affinity_is_equation_10():
    p, weights = points(30), np.random.default_rng(1).uniform(0.1, 1, 30)
    indices, distances = temporal.neighbors(p, 4)
    got = temporal.affinity(distances, indices, weights)
    sigma = np.median(distances)
    for i in range(30):
        for k in range(4):
            j = indices[i, k]
            near = np.exp(-np.sum((p[i] - p[j]) ** 2) / (2 * sigma**2))
            assert got[i, k] == pytest.approx(near * weights[i] * weights[j])


def test_loss_is_the_literal_double_loop():
    before, now = torch.from_numpy(points(20, 1)), torch.from_numpy(points(20, 2))
    weights = np.random.default_rng(3).uniform(0.2, 1, 20)
    indices, distances = temporal.neighbors(before.numpy(), 8)
    pair = temporal.affinity(distances, indices, weights)
    disp, dist = temporal.local_motion_loss(now, before, indices, pair, CFG)
    top_disp = top_dist = total = 0.0
    for i in range(20):
        for k, j in enumerate(indices[i]):
            d_i, d_j = (now[i] - before[i]).numpy(), (now[j] - before[j]).numpy()
            change = abs(np.linalg.norm(now[i] - now[j]) - np.linalg.norm(before[i] - before[j]))
            penalty = change**2 / 2 if change <= 0.01 else 0.01 * (change - 0.005)
            top_disp += pair[i, k] * np.linalg.norm(d_i - d_j)
            top_dist += pair[i, k] * penalty
            total += pair[i, k]
    # The root's 1e-8 mm^2 adds less than 1e-9 to displacements of millimeters.
    assert disp.item() == pytest.approx(top_disp / total, rel=1e-7)
    assert dist.item() == pytest.approx(top_dist / total, rel=1e-7)


def test_a_common_translation_costs_no_displacement():
    before = torch.from_numpy(points())
    disp, dist = loss(before + torch.tensor([3.0, -2.0, 1.0]), before)
    assert disp.item() == pytest.approx(1e-4, rel=1e-3)  # sqrt(1e-8): the floor under the root
    assert dist.item() < 1e-12


def test_a_rigid_motion_costs_no_distance():
    before = torch.from_numpy(points())
    angle = 0.7
    turn = torch.tensor(
        [[np.cos(angle), -np.sin(angle), 0], [np.sin(angle), np.cos(angle), 0], [0, 0, 1]], dtype=torch.float64
    )
    disp, dist = loss(before @ turn.T + 5, before)
    assert dist.item() < 1e-12 < disp.item()


def test_released_huber_is_the_literal_one_over_delta():
    x = torch.tensor([0.0, 0.003, 0.01, 0.5])
    literal, scaled = temporal.huber(x, 0.01, "literal"), temporal.huber(x, 0.01, "released")
    assert literal.tolist() == pytest.approx([0, 4.5e-6, 5e-5, 0.01 * 0.495])
    torch.testing.assert_close(scaled, literal / 0.01)


def test_gradient_against_central_differences():
    before = torch.from_numpy(points(15, 5))
    now = torch.from_numpy(points(15, 6)).requires_grad_()
    indices, distances = temporal.neighbors(before.numpy(), 8)
    pair = temporal.affinity(distances, indices, np.ones(15))

    def total(x):
        return sum(temporal.local_motion_loss(x, before, indices, pair, CFG))

    assert torch.autograd.gradcheck(total, now, eps=1e-6, atol=1e-6)


def test_gradient_is_finite_where_nothing_moves():
    before = torch.from_numpy(points())
    now = before.clone().requires_grad_()
    sum(loss(now, before)).backward()
    assert torch.isfinite(now.grad).all()
