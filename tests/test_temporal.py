"""Temporal term, Eqs. (9)-(11): literal loops, invariances, gradients, sampling."""

import numba
import numpy as np
import pytest
import torch
from reference import temporal as reference

from endoprior.model.presets import preset
from endoprior.training import local_motion, temporal
from endoprior.training.local_motion import affinity_numba, local_motion_numba, neighbors_numba

CFG = preset("paper").temporal


def points(num=40, seed=0):
    return np.random.default_rng(seed).uniform(-10, 10, (num, 3))


def with_torch(now, before, indices, pair_weights, smooth_l1=False):
    """The PyTorch implementation, given the arrays that the Numba one takes."""
    indices, pair_weights = torch.as_tensor(indices), torch.as_tensor(pair_weights)
    return local_motion.local_motion(now, before, indices, pair_weights, smooth_l1)


def loss(now, before, weights=None):
    indices, distances = neighbors_numba(before.detach().numpy(), local_motion.NUM_NEIGHBORS)
    weights = np.ones(len(before)) if weights is None else weights
    return local_motion_numba(now, before, indices, affinity_numba(distances, indices, weights))


def test_weights_and_samples_by_hand():
    assert temporal.motion_weight(np.array([0.45]), 0.45, 0.08)[0] == pytest.approx(0.5)
    assert temporal.kept_motion_weight(np.array([-1.0]))[0] == 0, "up to the least one"
    assert temporal.systematic_sample(np.array([0, 1.0, 0, 2.0]), 5).tolist() == [1, 3]


def test_relaxation_lowers_the_threshold_until_enough_count_or_to_its_floor():
    score = np.full(1000, 0.1)
    score[:20] = 0.9
    fixed, relaxed = (temporal.kept_motion_weight(score, relaxed=relaxed) for relaxed in (False, True))
    assert temporal.effective_size(relaxed) >= temporal.MIN_EFFECTIVE > temporal.effective_size(fixed)
    # After eight tries: threshold 0.25, temperature 0.30.
    floor = temporal.motion_weight(np.zeros(10), 0.25, 0.30)
    assert temporal.kept_motion_weight(np.zeros(10), relaxed=True) == pytest.approx(floor)


def test_systematic_sample_follows_the_weights():
    weights = np.r_[np.full(1000, 1.0), np.full(1000, 3.0)]
    chosen = temporal.systematic_sample(weights, 400)
    assert len(chosen) == 400 and len(set(chosen)) == 400
    assert (chosen >= 1000).mean() == pytest.approx(0.75, abs=0.01)  # evenly spaced marks: off by one at most


def test_a_refilled_sample_is_the_literal_loop():
    rng = np.random.default_rng(4)
    for count in (1, 7, 60, 100):
        weights = rng.random(120) ** 8  # a few hold most of the weight: several marks fall on each
        weights[rng.random(120) < 0.2] = 0
        chosen = temporal.systematic_sample(weights, count, refill=True)
        assert chosen.tolist() == reference.refilled_sample(weights.tolist(), count)
        assert len(chosen) == min(count, np.count_nonzero(weights))
    assert len(temporal.systematic_sample(weights, 60)) < 60


def test_relaxation_evaluates_eight_times(monkeypatch):
    score = np.linspace(0, 1, 30)  # thirty are never 256
    monkeypatch.setattr(temporal, "MOTION_THRESHOLD", 0.9)
    monkeypatch.setattr(temporal, "MOTION_TEMPERATURE", 0.01)
    weights = temporal.kept_motion_weight(score, relaxed=True)
    seven_steps = temporal.motion_weight(score, 0.9 - 7 * 0.05, 0.01 * 1.5**7)
    np.testing.assert_allclose(weights, np.where(seven_steps > 1e-4, seven_steps, 0), rtol=1e-9)
    np.testing.assert_allclose(weights, reference.relaxed_weights(score.tolist(), 256, 0.9, 0.01), rtol=1e-9)


def test_only_candidates_count_for_the_relaxation():
    """Gaussians that were never observed have score 1 in `released`; they take no part, so they relax nothing."""
    rng = np.random.default_rng(5)
    score, eligible = rng.beta(2, 8, 2200), rng.random(2200) < 0.5
    score[~eligible] = 1
    cfg = preset("released").temporal
    chosen, weights = temporal.choose(score, eligible, cfg, True)
    alone, want = temporal.choose(score[eligible], np.ones(eligible.sum(), bool), cfg, True)
    assert chosen.tolist() == np.flatnonzero(eligible)[alone].tolist() and len(chosen) == 1024
    np.testing.assert_array_equal(weights, want)
    relaxed = reference.relaxed_weights(score[eligible].tolist(), 256, 0.45, 0.08)
    assert alone.tolist() == reference.refilled_sample(relaxed, 1024)
    np.testing.assert_allclose(weights, np.array(relaxed)[alone], rtol=1e-9)


def test_choose_needs_enough_points():
    score, eligible = np.full(200, 0.9), np.zeros(200, bool)
    eligible[:100] = True
    assert len(temporal.choose(score, eligible, CFG)[0]) == 0  # 100 < 128
    eligible[:150] = True
    assert len(temporal.choose(score, eligible, CFG)[0]) == 150


def test_neighbors_agree_with_a_full_search():
    p = points(60)
    indices, distances = neighbors_numba(p, 5)
    table = np.linalg.norm(p[:, None] - p[None], axis=-1)
    np.fill_diagonal(table, np.inf)
    assert indices.tolist() == table.argsort(1)[:, :5].tolist()
    assert distances == pytest.approx(np.sort(table, 1)[:, :5])


def test_neighbors_of_coincident_points_leave_out_oneself():
    indices, _ = neighbors_numba(np.zeros((12, 3)), 8)
    assert indices.shape == (12, 8)
    assert not (indices == np.arange(12)[:, None]).any()


def test_affinity_is_equation_10():
    p, weights = points(30), np.random.default_rng(1).uniform(0.1, 1, 30)
    indices, distances = neighbors_numba(p, 4)
    got = affinity_numba(distances, indices, weights)
    np.testing.assert_allclose(got, reference.pair_weights(p, indices, weights))


def test_loss_is_the_literal_double_loop():
    before, now = points(20, 1), points(20, 2)
    weights = np.random.default_rng(3).uniform(0.2, 1, 20)
    indices, distances = neighbors_numba(before, 8)
    pair = affinity_numba(distances, indices, weights)
    got = local_motion_numba(torch.from_numpy(now), torch.from_numpy(before), indices, pair)
    # The root's 1e-8 mm^2 adds less than 1e-9 to displacements of millimeters.
    assert [term.item() for term in got] == pytest.approx(reference.local_motion(now, before, indices, pair), rel=1e-7)


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
    literal, scaled = local_motion.huber(x, 0.01), local_motion.huber(x, 0.01, smooth_l1=True)
    assert literal.tolist() == pytest.approx([0, 4.5e-6, 5e-5, 0.01 * 0.495])
    torch.testing.assert_close(scaled, literal / 0.01)


def test_gradient_against_central_differences(monkeypatch):
    monkeypatch.setattr(local_motion, "HUBER_DELTA", 2.0)
    now, before = (torch.from_numpy(points(15, seed)).requires_grad_() for seed in (5, 6))
    indices, distances = neighbors_numba(before.detach().numpy(), 8)
    pair = affinity_numba(distances, indices, np.ones(15))

    def terms(a, b):
        return local_motion_numba(a, b, indices, pair)

    assert torch.autograd.gradcheck(terms, (now, before), eps=1e-6, atol=1e-6)


def test_gradient_is_finite_where_nothing_moves():
    before = torch.from_numpy(points())
    now = before.clone().requires_grad_()
    sum(loss(now, before)).backward()
    assert torch.isfinite(now.grad).all()


def motion(num=600, seed=0, dtype=torch.float32):
    """A cloud that drifts, a little differently everywhere; neighbors; pair weights."""
    rng = np.random.default_rng(seed)
    before = torch.from_numpy(rng.uniform([-10, -10, 70], [10, 10, 90], (num, 3))).to(dtype)
    now = before + torch.from_numpy(rng.normal(0.5, 0.05, (num, 3))).to(dtype)
    indices, distances = neighbors_numba(before.numpy(), 8)
    return now, before, indices, affinity_numba(distances, indices, rng.uniform(0.1, 1, num))


def loss_and_gradients(function, now, before, indices, pair, smooth_l1=False, upstream=(2.0, -3.0)):
    now, before = now.clone().requires_grad_(), before.clone().requires_grad_()
    terms = function(now, before, indices, pair, smooth_l1)
    gradients = torch.autograd.grad(upstream[0] * terms[0] + upstream[1] * terms[1], (now, before))
    return *(t.detach() for t in terms), *gradients


# In float32 the change of a length is the difference of two roots near 1 mm: 1e-7 mm of error in changes of 0.01 mm.
@pytest.mark.parametrize(("dtype", "rtol"), [(torch.float32, 1e-4), (torch.float64, 1e-11)])
@pytest.mark.parametrize("smooth_l1", [False, True])
def test_fused_loss_and_gradient_are_those_of_the_torch_implementation(dtype, rtol, smooth_l1):
    now, before, indices, pair = motion(dtype=dtype)
    got = loss_and_gradients(local_motion_numba, now, before, indices, pair, smooth_l1)
    want = loss_and_gradients(with_torch, now.double(), before.double(), indices, pair, smooth_l1)
    for g, w in zip(got[:2], want[:2], strict=True):
        assert g.dtype == dtype and g.item() == pytest.approx(w.item(), rel=min(rtol, 1e-5))
    for g, w in zip(got[2:], want[2:], strict=True):
        assert g.dtype == dtype
        torch.testing.assert_close(g.double(), w, rtol=rtol, atol=rtol * w.abs().max().item())


def test_a_point_that_is_everybodys_neighbor_gets_all_their_pulls():
    now, before, indices, pair = motion(dtype=torch.float64)
    indices[1:, 3] = 0
    got = loss_and_gradients(local_motion_numba, now, before, indices, pair)
    want = loss_and_gradients(with_torch, now, before, indices, pair)
    for g, w in zip(got, want, strict=True):
        torch.testing.assert_close(g, w, rtol=1e-10, atol=1e-14)


def test_only_the_end_that_wants_a_gradient_gets_one():
    now, before, indices, pair = motion()
    both = loss_and_gradients(local_motion_numba, now, before, indices, pair, upstream=(1.0, 1.0))
    for wanted in (0, 1):
        ends = [now.clone(), before.clone()]
        ends[wanted].requires_grad_()
        sum(local_motion_numba(*ends, indices, pair)).backward()
        assert torch.equal(ends[wanted].grad, both[2 + wanted]) and ends[1 - wanted].grad is None
    assert not local_motion_numba(now, before, indices, pair)[0].requires_grad


def test_pulls_within_the_cloud_cancel():
    _, _, on_now, on_before = loss_and_gradients(local_motion_numba, *motion(dtype=torch.float64))
    for gradient in (on_now, on_before):  # the loss does not change when one end moves as a whole
        assert gradient.sum(0).abs().max() < 1e-12 < gradient.abs().max()


def test_the_number_of_threads_changes_no_bit():
    threads, results = numba.get_num_threads(), []
    try:
        for count in (1, threads):
            numba.set_num_threads(count)
            now, before, indices, pair = motion(3000)
            results.append(
                (
                    torch.from_numpy(pair),
                    *loss_and_gradients(local_motion_numba, now, before, indices, pair),
                )
            )
    finally:
        numba.set_num_threads(threads)
    for one, many in zip(*results, strict=True):
        assert torch.equal(one, many)


def test_pairs_without_weight_keep_a_little():
    p = points(30)
    indices, distances = neighbors_numba(p, 4)
    assert (affinity_numba(distances, indices, np.zeros(30)) == local_motion.SUM_EPS).all()


def test_a_point_at_nan_shows():
    now, before, indices, pair = motion()
    now[7] = torch.nan
    displacement, distance, on_now, on_before = loss_and_gradients(local_motion_numba, now, before, indices, pair)
    assert displacement.isnan() and distance.isnan() and on_now[7].isnan().all() and on_before[7].isnan().all()


def test_what_does_not_fit_together_is_an_error():
    now, before, indices, pair = motion()
    with pytest.raises(ValueError, match="before must have shape"):
        local_motion_numba(now, before[:-1], indices, pair)
    with pytest.raises(ValueError, match="before must have the type"):
        local_motion_numba(now, before.double(), indices, pair)
    for wrong in (-1, len(now)):
        indices[3, 2] = wrong
        with pytest.raises(ValueError, match="indices must be in"):
            local_motion_numba(now, before, indices, pair)
