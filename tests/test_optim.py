"""Adam: against torch's, with outer-product gradients, and with basis functions that are not looked at."""

from dataclasses import replace
from functools import partial

import numpy as np
import pytest
import torch

from endoprior.core.config import OptimConfig
from endoprior.initialization.first_gaussians import create_gaussians
from endoprior.model.gaussians import RankOneGradient, change_layout
from endoprior.model.method import method_of
from endoprior.model.presets import preset
from endoprior.training.adam import AdamState
from endoprior.training.ops import NUMBA
from endoprior.training.optimizer import BASIS_DECAY, Optimizer, late_share, log_linear, rate_of, temporal_rates
from endoprior.training.trainer import Stage


def test_update_is_torchs_adam():
    g = torch.Generator().manual_seed(0)
    ours = torch.randn(7, 3, 5, generator=g).requires_grad_()
    theirs = ours.detach().clone().requires_grad_()
    adam, state = torch.optim.Adam([theirs], lr=1e-2, eps=1e-15), AdamState(ours)
    for _ in range(10):
        ours.grad = torch.randn(7, 3, 5, generator=g)
        theirs.grad = ours.grad.clone()
        NUMBA.adam_step([state], [ours], 1e-2, 1e-15)
        adam.step()
    # Ten steps of float32, rounded in another order.
    torch.testing.assert_close(ours, theirs, rtol=1e-5, atol=1e-6)


def test_outer_product_gradients_are_the_written_out_ones():
    rng = np.random.default_rng(0)
    motion = torch.from_numpy(rng.normal(size=(6, 4, 3)).astype(np.float32)).requires_grad_()
    dense = motion.detach().clone().requires_grad_()
    state, adam = AdamState(motion, 4), AdamState(dense)
    for _ in range(5):
        gradients = [RankOneGradient("motion", rng.random(4).astype(np.float32), torch.randn(6, 3)) for _ in range(2)]
        dense.grad = torch.from_numpy(sum(np.einsum("b,nc->nbc", g.weights, g.v_offsets.numpy()) for g in gradients))
        NUMBA.adam_basis_step(state, motion, gradients, np.full(3, 1e-2), 1e-15)
        NUMBA.adam_step([adam], [dense], 1e-2, 1e-15)
    torch.testing.assert_close(motion, dense, rtol=1e-5, atol=1e-6)  # float32 sums in another order


def test_basis_functions_without_weight_stay_unchanged():
    motion = torch.zeros(2, 4, 3).requires_grad_()
    state = AdamState(motion, 4)
    for weights in ([1.0, 0.5, 0, 0], [0, 0, 0.5, 1.0]):
        gradient = RankOneGradient("motion", np.array(weights, np.float32), torch.ones(2, 3))
        NUMBA.adam_basis_step(state, motion, [gradient], np.array([1e-2, 1e-2, 0.0]), 1e-15)
    # Each was stepped once, so Adam's first step, of length lr, is all that happened; the last channel has rate 0.
    torch.testing.assert_close(motion.detach()[..., :2], torch.full((2, 4, 2), -1e-2))
    assert not motion.detach()[..., 2].any()
    assert state.steps.tolist() == [1, 1, 1, 1]


def test_rates_without_a_final_value_fall_late():
    optim = OptimConfig(late_decay=0.1, decay_iterations=1000)
    shares = [late_share(optim, iteration) for iteration in (1, 750, 875, 1000, 3000)]
    assert shares == pytest.approx([1, 1, 0.1**0.5, 0.1, 0.1])
    constant = OptimConfig(late_decay=1.0)
    assert late_share(replace(constant, decay_iterations=1), 1) == late_share(constant, 4000) == 1


def test_without_a_gradient_nothing_moves():
    cfg = preset("paper")
    rng = np.random.default_rng(0)
    model = create_gaussians(rng.random((5, 3)), rng.random((5, 3)), np.zeros(5), cfg)
    optimizer = Optimizer(model, None, cfg, partial(rate_of, cfg=cfg, spatial_scale=1.0), NUMBA)
    model["means"].grad = torch.ones(5, 3)
    optimizer.step(1)
    moved, first = model["means"].detach().clone(), optimizer.states["means"].first.clone()
    assert model["means"].grad is None
    optimizer.step(2)
    assert torch.equal(model["means"].detach(), moved) and torch.equal(optimizer.states["means"].first, first)
    assert optimizer.states["means"].steps == 1 and optimizer.states["quats"].steps == 0


def test_log_linear_ends_and_middle():
    assert [log_linear(1e-2, 1e-4, i, 10) for i in (0, 5, 10, 99)] == pytest.approx([1e-2, 1e-3, 1e-4, 1e-4])


def test_rates_of_temporal_coefficients_follow_the_layout():
    cfg = preset("default", **{"deformation.deform_opacity": True})
    assert set(change_layout(cfg)) == {"quats", "log_scales", "opacity_logits", "sh_dc"}
    rates = {name: temporal_rates(name, cfg, 0) for name in ("motion", "changes")}
    assert [len(each) for each in rates.values()] == [3, 11]
    others = np.delete(rates["changes"], change_layout(cfg)["opacity_logits"])
    assert others == pytest.approx(cfg.optim.basis_lr) and rates["motion"] == pytest.approx(cfg.optim.basis_lr)
    for name, before in rates.items():
        assert temporal_rates(name, cfg, cfg.optim.decay_iterations) == pytest.approx(before * BASIS_DECAY)


def test_published_schedules_have_the_rates_of_3dgs_and_ours_faster_ones():
    def first(name, preset_name):
        return rate_of(name, preset(preset_name), 1.0)(1)

    assert [first(name, "paper") for name in ("sh_dc", "opacity_logits")] == [2.5e-3, 5e-2]
    assert [first(name, "default") for name in ("sh_dc", "opacity_logits")] == [4e-3, 8e-2]
    assert first("color_slopes", "default") == 2.5e-3  # faster ones diverge


def test_an_epoch_of_ours_takes_every_frame_once_and_a_published_one_any_at_random():
    def positions(name):
        cfg, method = preset(name), method_of(preset(name))
        rngs = (np.random.default_rng([cfg.seed, i]) for i in range(1, 41))
        return [method.position(cfg, Stage.FINE, i, 8, rng) for i, rng in enumerate(rngs, 1)]

    ours, literal = positions("default"), positions("paper")
    assert all(sorted(ours[i : i + 8]) == [*range(8)] for i in range(0, 40, 8)) and ours[:8] != ours[8:16]
    assert any(sorted(literal[i : i + 8]) != [*range(8)] for i in range(0, 40, 8))
    assert method_of(preset("default")).position(preset("default"), Stage.COARSE, 5, 8, np.random.default_rng(0)) == 0
