"""Density control on generated statistics: disjoint, bounded, equivariant plans, applied to finite Gaussians."""

from __future__ import annotations

import math
from dataclasses import replace
from functools import partial
from unittest import mock

import numpy as np
import pytest
import torch
from hypothesis import given
from hypothesis import strategies as st
from hypothesis_profiles import examples

from endoprior.core.config import DensityConfig, ReleasedMethod
from endoprior.core.types import RenderOutput
from endoprior.initialization.first_gaussians import create_gaussians
from endoprior.model.presets import preset
from endoprior.training import density
from endoprior.training.density import DensityStats, apply_plan
from endoprior.training.ops import NUMBA
from endoprior.training.optimizer import Optimizer, rate_of

SEEDS = st.integers(0, 2**31 - 1)
EMPTY = torch.zeros(0)


@st.composite
def states(draw):
    """Statistics, scales, opacities and extent of 0 to 40 Gaussians, and a config."""
    rng, num = np.random.default_rng(draw(SEEDS)), draw(st.integers(0, 40))
    seen, valid = rng.integers(0, 30, num), rng.integers(0, 60, num)
    gradient = rng.choice([0.0, 1e-30, 1e-4, 2e-4, 1.0, 1e30], num) * seen
    seen_opacity = rng.choice([0.0, 0.001, 0.5, 1.0], num) * valid
    values = (gradient, seen, rng.random(num) * valid, valid, seen_opacity)
    stats = DensityStats(*(torch.tensor(np.asarray(v), dtype=torch.float32) for v in values))
    scales = torch.tensor(10.0 ** rng.uniform(-8, 8, (num, 1)) * rng.uniform(0.1, 1, (num, 3)), dtype=torch.float32)
    opacities = torch.tensor(rng.choice(draw(st.sampled_from([[0.0], [1.0], [0.0, 0.004, 0.3, 1.0]])), num)).float()
    cfg = DensityConfig(min_densify_weight=draw(st.sampled_from([0.35, 1.0])))
    largest = draw(st.sampled_from([0.0, 40.0]))
    released = ReleasedMethod(prior=draw(st.booleans()), prune_max_scale_mm=largest)
    extent = draw(st.sampled_from([0.0, 1.0, 1e6, math.inf]))
    return stats, scales, opacities, extent, cfg, released


@given(states(), st.sampled_from([1, 20, 45, 200_000]))
def test_a_plan_is_disjoint_and_never_grows_beyond_the_limit(made, limit):
    stats, scales, opacities, _, cfg, released = made
    with mock.patch.object(density, "MAX_GAUSSIANS", limit):
        planned = density.plan(*made)
    num, sets = len(scales), (planned.clone, planned.split, planned.remove)
    assert all(s.shape == (num,) and s.dtype == torch.bool for s in sets)
    assert (sum(s.int() for s in sets) <= 1).all()
    after = num + int(planned.clone.sum()) + int(planned.split.sum()) - int(planned.remove.sum())
    assert 0 <= after <= max(num, limit)
    assert (planned.remove | ~(opacities < cfg.prune_opacity)).all()  # the faint always go
    still = (stats.grad2d_ndc_sum == 0) & (stats.num_seen > 0)
    assert not (planned.clone[still].any() or planned.split[still].any())
    score = stats.score(released.unobserved_score)
    assert torch.isfinite(score).all() and (score >= 0).all() and (score <= 1).all()


@given(states(), SEEDS)
def test_a_plan_does_not_depend_on_the_order(made, seed):
    stats, scales, opacities, extent, *rules = made
    order = torch.randperm(len(scales), generator=torch.Generator().manual_seed(seed))
    want = density.plan(*made)
    mixed = DensityStats(*(value[order] for value in stats.tensors().values()))
    got = density.plan(mixed, scales[order], opacities[order], extent, *rules)
    assert all(torch.equal(getattr(got, name), getattr(want, name)[order]) for name in ("clone", "split", "remove"))


@given(states())
def test_an_infinite_gradient_or_none_at_all_makes_no_one_vanish(made):
    """Statistics that are no numbers move nobody; growth by infinity is growth."""
    stats, scales, opacities, extent, *_ = made
    solid = torch.ones_like(opacities)
    cfg = DensityConfig(min_densify_weight=1.0)
    for value, grows in ((math.nan, False), (math.inf, True)):
        odd = replace(stats, grad2d_ndc_sum=torch.full_like(opacities, value), num_seen=torch.ones_like(opacities))
        planned = density.plan(odd, scales, solid, extent, cfg)
        assert not planned.remove.any()
        assert ((planned.clone | planned.split) == grows).all()


@examples(20)
@given(states(), st.sampled_from([0, 3]))
def test_an_applied_plan_gives_the_planned_number_of_finite_gaussians(made, degree):
    stats, scales, _, extent, *rules = made
    num, config = len(scales), preset("paper")
    config = replace(config, schedule=replace(config.schedule, sh_degree=degree))
    rng = np.random.default_rng(num)
    gaussians = create_gaussians(rng.normal(size=(num, 3)), rng.random((num, 3)), scales.amax(-1).log().numpy(), config)
    optimizer = Optimizer(gaussians, None, config, partial(rate_of, cfg=config, spatial_scale=1.0), NUMBA)
    planned = density.plan(stats, gaussians.scales, gaussians.opacities, extent, *rules)
    new, _ = apply_plan(optimizer, planned, stats, rng)
    after = num + int(planned.clone.sum()) + int(planned.split.sum()) - int(planned.remove.sum())
    assert len(gaussians) == after
    assert all(len(value) == after and torch.isfinite(value).all() for value in gaussians.tensors.values())
    assert all(len(value) == after and torch.isfinite(value).all() for value in new.tensors().values())
    assert (new.grad2d_ndc_sum == 0).all() and new.num_valid.sum() <= stats.num_valid.sum()
    moments = [m for state in optimizer.states.values() for m in (state.first, state.second)]
    assert all(len(m) == after for m in moments)


@given(SEEDS, st.integers(1, 9), st.integers(1, 9), st.integers(0, 30), st.floats(0, 1), st.sampled_from([1.0, 2.0]))
def test_scores_stay_within_the_prior(seed, height, width, num, level, scale):
    """Centers anywhere, also nowhere: only what is drawn, inside, and on tissue counts; rho = c gives c."""
    rng = np.random.default_rng(seed)
    means2d = rng.uniform(-3, max(width, height) + 3, (num, 2))
    means2d[rng.random((num, 2)) < 0.2] = rng.choice([np.nan, np.inf, -np.inf, 1e38, 0.0, float(width)])
    radii = torch.tensor(rng.integers(0, 3, num), dtype=torch.int32)
    out = RenderOutput(EMPTY, EMPTY, EMPTY, torch.tensor(means2d, dtype=torch.float32), radii)
    mask, prior = torch.tensor(rng.random((height, width)) < 0.6), torch.full((height, width), level)
    stats = DensityStats.zeros(num)
    NUMBA.add_score(stats, out, prior, mask, torch.full((num,), 0.5), scale)
    valid = stats.num_valid > 0
    assert not valid[radii == 0].any() and (mask.any() or not valid.any())
    inside = torch.tensor(((means2d * scale >= 0) & (means2d * scale <= [width, height])).all(-1))
    assert not valid[~inside].any()
    assert stats.score(0.0)[valid].numpy() == pytest.approx(level, abs=2e-6)
    if scale == 1.0:
        assert torch.equal(NUMBA.valid_projection(out.means2d, radii, mask), valid)


@given(SEEDS, st.integers(0, 20))
def test_gradients_of_what_was_not_drawn_are_not_looked_at(seed, num):
    rng = np.random.default_rng(seed)
    radii = torch.tensor(rng.integers(0, 2, num), dtype=torch.int32)
    means2d = torch.zeros(num, 2, requires_grad=True)
    means2d.grad = torch.tensor(rng.normal(size=(num, 2)), dtype=torch.float32)
    means2d.grad[radii == 0] = math.nan
    stats = DensityStats.zeros(num)
    NUMBA.add_gradient(stats, RenderOutput(EMPTY, EMPTY, EMPTY, means2d, radii), 40, 30)
    assert torch.isfinite(stats.grad2d_ndc_sum).all() and torch.equal(stats.num_seen, radii.float())


@given(SEEDS, st.integers(1, 30), st.sampled_from([0.0, 1e-30, 1.0, 1e15]))
def test_extent_is_a_length_and_moves_with_nothing(seed, num, size):
    centers = torch.tensor(np.random.default_rng(seed).normal(size=(num, 3)) * size)
    extent = density.scene_extent(centers)
    assert extent >= 0 and math.isfinite(extent)
    if num < 2:
        assert extent == 0.0
    elif size:
        assert density.scene_extent(centers + 3 * size) == pytest.approx(extent, rel=1e-6)
