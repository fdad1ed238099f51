"""Density control: the score of Eq. (7), the weight of Eq. (8), the plan, and its application."""

from dataclasses import replace
from functools import partial

import numpy as np
import pytest
import torch

from endoprior.compute.morton import morton_order
from endoprior.core.config import ReleasedMethod
from endoprior.core.types import RenderOutput
from endoprior.initialization.first_gaussians import create_gaussians
from endoprior.model.presets import preset
from endoprior.training import density
from endoprior.training.density import DensityStats, Plan, apply_plan, split_children
from endoprior.training.ops import NUMBA
from endoprior.training.optimizer import Optimizer, rate_of

CFG = preset("paper").density


def output(means2d, radii=None):
    means2d = torch.tensor(means2d, dtype=torch.float32).reshape(-1, 2).requires_grad_()
    radii = torch.ones(len(means2d), dtype=torch.int32) if radii is None else torch.tensor(radii, dtype=torch.int32)
    empty = torch.zeros(0)
    return RenderOutput(empty, empty, empty, means2d, radii)


def stats_of(num, *, gradient=0.0, score=None, num_valid=0, opacity=0.5):
    stats = DensityStats.zeros(num)
    stats.grad2d_ndc_sum += gradient
    stats.num_seen += 1
    if score is not None:
        stats.num_valid += num_valid
        stats.score_sum += score * num_valid
        stats.opacity_sum += opacity * num_valid
    return stats


def gaussians(num, cfg=None, seed=0):
    rng = np.random.default_rng(seed)
    return create_gaussians(
        rng.normal(size=(num, 3)), rng.random((num, 3)), rng.normal(size=num), cfg or preset("paper")
    )


@pytest.mark.parametrize("c", [0.0, 0.3, 1.0])
def test_a_constant_prior_gives_that_score_to_every_observed_gaussian(c):
    stats = DensityStats.zeros(3)
    prior, mask = torch.full((20, 30), c), torch.ones(20, 30, dtype=torch.bool)
    for _ in range(5):
        NUMBA.add_score(stats, output([[3, 4], [29.9, 0.1], [15, 10]]), prior, mask, torch.full((3,), 0.4))
    # epsilon 1e-6 in the denominator of Eq. (7)
    assert stats.score(0.0).tolist() == pytest.approx([c] * 3, abs=1e-6)
    assert stats.mean_opacity(torch.zeros(3)).tolist() == pytest.approx([0.4] * 3)


def test_score_samples_a_ramp_at_the_projected_centre():
    ramp = (torch.arange(30) + 0.5).expand(20, 30) / 30  # value x / 30 at x px
    stats = DensityStats.zeros(2)
    NUMBA.add_score(
        stats,
        output([[7.25, 3.0], [20.5, 12.0]]),
        ramp.contiguous(),
        torch.ones(20, 30, dtype=torch.bool),
        torch.ones(2),
    )
    assert stats.score(0.0).tolist() == pytest.approx([7.25 / 30, 20.5 / 30], abs=1e-5)


def test_projections_off_the_image_off_tissue_or_undrawn_do_not_count():
    mask = torch.ones(20, 30, dtype=torch.bool)
    mask[:, :10] = False
    stats = DensityStats.zeros(5)
    where = [[-1, 5], [15, 25], [4, 4], [20, 10], [20, 10]]
    NUMBA.add_score(stats, output(where, [1, 1, 1, 0, 1]), torch.ones(20, 30), mask, torch.ones(5))
    assert stats.num_valid.tolist() == [0, 0, 0, 0, 1]


@pytest.mark.parametrize("scale", [1.0, 2.0])
def test_score_agrees_with_grid_sample(scale):
    """Over more than one task, on and off the image, NaN among them."""
    generator = torch.Generator().manual_seed(0)
    num = 3000
    means2d = torch.rand(num, 2, generator=generator) * torch.tensor([40.0, 30.0]) - 5
    means2d[7], means2d[8, 1], means2d[9] = torch.nan, torch.inf, torch.tensor([30.0, 20.0]) / scale
    radii = torch.randint(0, 3, (num,), generator=generator, dtype=torch.int32)
    prior, mask = torch.rand(20, 30, generator=generator), torch.rand(20, 30, generator=generator) > 0.3
    opacities = torch.rand(num, generator=generator)
    stats = DensityStats.zeros(num)
    NUMBA.add_score(stats, output(means2d.tolist(), radii.tolist()), prior, mask, opacities, scale)

    grid = (2 * scale * means2d / torch.tensor([30.0, 20.0]) - 1)[None, None]
    maps = torch.stack([prior, mask.float()])[None]
    value, on_tissue = torch.nn.functional.grid_sample(maps, grid, padding_mode="border", align_corners=False)[0, :, 0]
    inside = ((scale * means2d >= 0) & (scale * means2d <= torch.tensor([30.0, 20.0]))).all(-1)
    clear = (on_tissue - 0.5).abs() > 1e-5  # float32: the threshold may fall either way
    valid = inside & (radii > 0) & (on_tissue > 0.5)
    assert 100 < valid.sum() < num - 100
    assert torch.equal(stats.num_valid[clear], valid.float()[clear])
    torch.testing.assert_close(stats.score_sum[clear], torch.where(valid, value, 0)[clear], rtol=1e-5, atol=1e-5)
    assert torch.equal(stats.opacity_sum[clear], torch.where(valid, opacities, 0)[clear])
    found = NUMBA.valid_projection(scale * means2d, radii, mask)
    assert torch.equal(found, stats.num_valid > 0)


@pytest.mark.parametrize(("unobserved", "factor"), [(0.0, 0.35), (1.0, 1.0)])
def test_score_and_factor_of_an_unobserved_gaussian(unobserved, factor):
    score = DensityStats.zeros(2).score(unobserved)
    assert score.tolist() == [unobserved] * 2
    assert density.densify_weight(score, CFG).tolist() == pytest.approx([factor] * 2)


def test_gradient_is_counted_in_ndc_and_only_where_drawn():
    out = output([[1, 1], [2, 2]], [1, 0])
    out.means2d.grad = torch.tensor([[3.0, 4.0], [1.0, 1.0]])
    stats = DensityStats.zeros(2)
    NUMBA.add_gradient(stats, out, width=200, height=100)
    assert stats.grad2d_ndc_sum.tolist() == pytest.approx([np.hypot(300, 200), 0])
    assert stats.num_seen.tolist() == [1, 0]


GROWING = {"gradient": 1.0, "score": 1.0, "num_valid": 1}
LIMITED = ReleasedMethod(prune_max_scale_mm=40.0)


@pytest.mark.parametrize(
    ("largest", "opacities", "extent", "released", "known", "does"),
    [
        ([1e-3] * 3, 0.5, 0.0, None, GROWING, "sss"),  # nothing is cloned at extent zero
        ([0.5, 5.0], 0.5, 100.0, None, GROWING, "cs"),  # small ones are cloned in a large scene
        ([1.0, 41.0, 1.0], [0.004, 0.5, 0.5], 0.0, LIMITED, {}, "rr."),  # faint and huge ones go
        ([50.0, 70.0], 0.5, 0.0, LIMITED, GROWING, "sr"),  # the children of the first one fit
        ([1.0, 1.0], 0.5, 0.0, None, {"gradient": [4e-4, 6e-4], "score": 0.0, "num_valid": 5}, ".s"),  # 0.35 x 6e-4
        ([1.0, 1.0], 0.5, 0.0, None, {"gradient": [1.9e-4, 2.1e-4], "score": 1.0, "num_valid": 10**6}, ".s"),
    ],
)
def test_what_a_plan_does_to_each(largest, opacities, extent, released, known, does):
    """`c` clone, `s` split, `r` remove; the longest axis of each Gaussian is given."""
    num = len(largest)
    known = known | {"gradient": torch.tensor(known.get("gradient", 0.0))}
    scales = torch.tensor(largest)[:, None] * torch.tensor([1.0, 0.2, 0.2])
    planned = density.plan(stats_of(num, **known), scales, torch.tensor(opacities).expand(num), extent, CFG, released)
    for letter, rows in (("c", planned.clone), ("s", planned.split), ("r", planned.remove)):
        assert rows.tolist() == [each == letter for each in does], letter


def test_a_floor_of_one_is_plain_growth():
    stats = stats_of(2, gradient=torch.tensor([1.9e-4, 2.1e-4]), score=0.0, num_valid=10**6)
    cfg = replace(CFG, min_densify_weight=1.0)
    planned = density.plan(stats, torch.ones(2, 3), torch.full((2,), 0.5), 0.0, cfg)
    assert planned.split.tolist() == [False, True]


@pytest.mark.parametrize(
    ("num_valid", "score", "opacity", "gone"),
    [(20, 0.1, 0.007, True), (19, 0.1, 0.007, False), (20, 0.3, 0.007, False), (20, 0.1, 0.008, False)],
)
def test_prior_prune_needs_all_three(num_valid, score, opacity, gone):
    stats = stats_of(1, score=score, num_valid=num_valid, opacity=opacity)
    for cfg, goes in ((CFG, gone), (replace(CFG, min_densify_weight=1.0), False)):
        assert density.plan(stats, torch.ones(1, 3), torch.tensor([0.5]), 0.0, cfg).remove.item() is goes


def test_growth_stops_at_the_guard(monkeypatch):
    monkeypatch.setattr(density, "MAX_GAUSSIANS", 3)
    planned = density.plan(stats_of(3, gradient=1.0), torch.ones(3, 3), torch.full((3,), 0.5), 0.0, CFG)
    assert not planned.split.any()


def test_events_of_the_published_schedule():
    coarse = {i for i in range(1, 1001) if density.due(i, False, CFG)}
    fine = {i for i in range(1, 3001) if density.due(i, i == 3000, CFG)}
    assert coarse == {600, 700, 800, 900, 1000}
    assert fine == set(range(600, 3000, 100)) and len(fine) == 24


@pytest.mark.parametrize("kind", ["hexplane", "basis"])
def test_every_row_stays_together_through_a_plan(kind):
    cfg = preset("paper", **{"deformation.basis.num_bases": 31, "deformation.basis.num_frames": 5})
    cfg = replace(cfg, deformation=replace(cfg.deformation, kind=kind))
    model = gaussians(6, cfg)
    optimizer = Optimizer(model, None, cfg, partial(rate_of, cfg=cfg, spatial_scale=10.0), NUMBA)
    for i, (name, value) in enumerate(model.tensors.items()):  # mark every row of every tensor by its Gaussian
        marks = torch.arange(6.0).reshape(-1, *[1] * (value.ndim - 1)) + 10 * i
        value.data += 0 if name in ("means", "quats", "log_scales") else marks
        if name != "frame_motion":  # which no gradient trains
            optimizer.states[name].first += marks + 1
    before = {name: value.detach().clone() for name, value in model.tensors.items()}
    stats = DensityStats(*(torch.arange(6.0) + k for k in range(5)))
    flags = torch.eye(6, dtype=torch.bool)
    planned = Plan(clone=flags[1], split=flags[2], remove=flags[4])
    grown, returned = apply_plan(optimizer, planned, stats, np.random.default_rng(0))
    # The marks say which Gaussian each row was: the kept ones, the clone, two children, in an order of their own.
    parents = (model["opacity_logits"].detach()[:, None] - before["opacity_logits"]).abs().argmin(1)
    assert sorted(parents.tolist()) == [0, 1, 1, 2, 2, 3, 5]
    assert torch.equal(returned, parents)
    assert np.array_equal(morton_order(model["means"].detach().numpy()), np.arange(7))
    old = optimizer.states["opacity_logits"].first > 0
    assert sorted(parents[old].tolist()) == [0, 1, 3, 5]
    assert torch.equal(model["means"].detach()[old], before["means"][parents[old]])
    for name, value in model.tensors.items():
        assert len(value) == 7 and value.requires_grad and value.is_leaf and value.is_contiguous()
        if name not in ("means", "log_scales"):
            torch.testing.assert_close(value.detach(), before[name][parents])
        if name == "frame_motion":
            continue
        state = optimizer.states[name]
        assert state.first.shape == state.second.shape == value.shape
        marks = parents + 1 + 10 * list(model.tensors).index(name)
        assert torch.equal(state.first.reshape(7, -1)[:, 0], torch.where(old, marks.float(), 0))
    assert torch.equal(grown.num_valid, torch.where(old, parents + 3.0, 0))
    assert not grown.grad2d_ndc_sum.any() and not grown.num_seen.any()


def test_children_of_a_split_come_from_the_parent_and_are_smaller():
    model = gaussians(1)
    model["means"].data[:] = torch.tensor([1.0, 2.0, 3.0])
    model["log_scales"].data[:] = torch.log(torch.tensor([2.0, 1e-6, 1e-6]))
    model["quats"].data[:] = torch.tensor([np.sqrt(0.5), 0, 0, np.sqrt(0.5)])  # a quarter turn about z: x becomes y
    children = split_children(model, torch.tensor([True]), 1.6, np.random.default_rng(0))
    moved = children["means"] - torch.tensor([1.0, 2.0, 3.0])
    assert (moved[:, 1].abs() > 1e-2).all() and moved[:, [0, 2]].abs().max() < 1e-4
    torch.testing.assert_close(children["log_scales"].exp()[:, 0], torch.full((2,), 2.0 / 1.6))


def test_extent_of_a_still_camera_is_zero():
    assert density.scene_extent(torch.zeros(5, 3)) == 0
    assert density.scene_extent(torch.tensor([[0.0, 0, 0], [2.0, 0, 0]])) == pytest.approx(1.1)
