"""The two implementations of each operation, Numba and PyTorch, compute the same; training with either agrees."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
import torch
from hexplane_grids import planes, random_grid, random_layer, random_unit, sample
from reference import adam
from tiny_training import tiny_config

from endoprior.core.types import RenderOutput
from endoprior.data import load_sequence
from endoprior.model.gaussians import RankOneGradient
from endoprior.model.scene_file import load_scene
from endoprior.training.adam import AdamState
from endoprior.training.density import DensityStats
from endoprior.training.gaussian_trainer import GaussianTrainer
from endoprior.training.ops import NUMBA, TORCH

KINDS = ("basis", "hexplane")
BOTH = pytest.mark.parametrize("ops", [NUMBA, TORCH], ids=lambda ops: ops.model.name)


@pytest.mark.parametrize("kind", KINDS)
@pytest.mark.parametrize("ends", [pytest.param("current", marks=pytest.mark.slow), "both"])
def test_training_agrees(tiny_sequence, kind, ends):
    cfg = tiny_config(kind)
    cfg = replace(cfg, temporal=replace(cfg.temporal, gradient=ends))
    found = []
    for ops in (NUMBA, TORCH):
        trainer = GaussianTrainer(load_sequence(tiny_sequence), cfg, ops)
        trainer.start()
        found.append([trainer.step() for _ in range(20)])
    assert any("distance" in report.terms for report in found[0])
    losses, counts = ([[f(r) for r in reports] for reports in found] for f in (
        lambda report: sum(report.terms.values()), lambda report: report.num_gaussians))  # fmt: skip
    assert losses[1] == pytest.approx(losses[0], rel=2e-3)
    assert counts[1] == pytest.approx(counts[0], rel=0.02)


def test_hexplane_agrees():
    """Two times at once: values, gradients of positions, planes and layer."""
    cfg, times = planes((5, 4, 6), 7, 20, (1, 3)), (0.2, 0.93)
    found = []
    for ops in (NUMBA, TORCH):
        grid = random_grid(cfg)
        unit = random_unit(150, 3, -0.2, 1.2).requires_grad_(True)
        weight, bias = random_layer(grid)
        out = torch.stack(ops.model.hexplane_linear(grid, unit, times, weight, bias))
        (out * torch.randn(out.shape, generator=torch.Generator().manual_seed(1))).sum().backward()
        found.append([out, unit.grad, weight.grad, bias.grad, grid.grads])
    for ours, theirs in zip(*found, strict=True):
        torch.testing.assert_close(ours, theirs, rtol=1e-4, atol=1e-4 * float(theirs.detach().abs().max()))


def test_hexplane_in_torch_keeps_nan_positions():
    grid, unit = random_grid(), torch.full((3, 3), float("nan"))
    with torch.no_grad():
        assert sample(grid, unit, 0.3, TORCH.model.hexplane_linear).isnan().all()


def test_basis_sums_agree():
    generator = torch.Generator().manual_seed(0)
    motion, weights = torch.randn(300, 9, 13, generator=generator), np.array([0, 0, 0.2, 1, 0.7, 0, 0, 0, 0])
    ours, theirs = (ops.model.weighted_sum(motion, weights) for ops in (NUMBA, TORCH))
    torch.testing.assert_close(ours, theirs)
    ours, theirs = (ops.model.weighted_sum_backward(ours, weights) for ops in (NUMBA, TORCH))
    torch.testing.assert_close(ours, theirs)


def test_statistics_agree():
    generator, num = torch.Generator().manual_seed(0), 500
    means2d = torch.rand(num, 2, generator=generator) * torch.tensor([44.0, 34.0]) - 2
    means2d.requires_grad_().grad = torch.randn(num, 2, generator=generator)
    radii = torch.randint(0, 3, (num,), generator=generator, dtype=torch.int32)
    mask, prior = torch.rand(30, 40, generator=generator) < 0.7, torch.rand(30, 40, generator=generator)
    out, opacities = RenderOutput(None, None, None, means2d, radii), torch.rand(num, generator=generator)
    stats = [DensityStats.zeros(num) for _ in range(2)]
    for ops, each in zip((NUMBA, TORCH), stats, strict=True):
        ops.add_gradient(each, out, 40, 30)
        ops.add_score(each, out, prior, mask, opacities)
    assert stats[0].num_valid.sum() > 0
    for name, value in stats[0].tensors().items():
        torch.testing.assert_close(value, stats[1].tensors()[name], rtol=1e-5, atol=1e-5)
    before = [value.clone() for value in stats[1].tensors().values()]
    TORCH.add_gradient(stats[1], out, 40, 30, torch.tensor(1.0))
    TORCH.add_score(stats[1], out, prior, mask, opacities, 1.0, torch.tensor(1.0))
    assert all(torch.equal(a, b) for a, b in zip(before, stats[1].tensors().values(), strict=True))


@pytest.mark.parametrize("kind", KINDS)
def test_the_temporal_term_agrees(kind):
    generator = torch.Generator().manual_seed(1)
    before = torch.randn(200, 3, generator=generator) * 20
    now = (before + torch.randn(200, 3, generator=generator)).requires_grad_()
    weights = torch.from_numpy(np.random.default_rng(0).random(200).astype(np.float32))
    found = []
    for ops in (NUMBA, TORCH):
        terms = ops.local_consistency(now, before, weights, tiny_config(kind).temporal)
        found.append([torch.stack(terms), *torch.autograd.grad(sum(terms), now)])
    torch.testing.assert_close(found[1][0], found[0][0], rtol=1e-4, atol=1e-6)
    torch.testing.assert_close(found[1][1], found[0][1], rtol=1e-3, atol=1e-6)


@BOTH
def test_every_step_is_adam(ops):
    rng, rates = np.random.default_rng(0), np.array([1e-2, 3e-2, 1e-3])
    motion = torch.from_numpy(rng.normal(size=(6, 4, 3)).astype(np.float32)).requires_grad_()
    plain = motion.detach().clone().requires_grad_()
    want, plain_want = motion.detach().clone().double(), motion.detach().clone().double()
    moments, plain_moments = (tuple(torch.zeros(6, 4, 3, dtype=torch.float64) for _ in range(2)) for _ in range(2))
    state, plain_state = AdamState(motion, 4), AdamState(plain)
    for step in range(1, 6):
        weights, v_offsets = rng.random(4), torch.randn(6, 3)
        plain.grad = torch.from_numpy(weights).float()[:, None] * v_offsets[:, None]
        adam.step(want, plain.grad.double(), *moments, step, torch.from_numpy(rates))
        adam.step(plain_want, plain.grad.double(), *plain_moments, step, 1e-2)
        ops.adam_basis_step(state, motion, [RankOneGradient("motion", weights, v_offsets)], rates, 1e-15)
        ops.adam_step([plain_state], [plain], 1e-2, 1e-15)
    torch.testing.assert_close(motion.detach().double(), want, rtol=1e-4, atol=1e-6)
    torch.testing.assert_close(plain.detach().double(), plain_want, rtol=1e-4, atol=1e-6)


def test_a_skipped_step_changes_nothing():
    generator = torch.Generator().manual_seed(0)
    plain, motion = (torch.randn(5, 4, 3, generator=generator).requires_grad_() for _ in range(2))
    states = [AdamState(plain), AdamState(motion, 4)]
    for skip, value in ((0.0, 1.0), (1.0, float("nan")), (0.0, 1.0)):
        before = [t.clone() for s in states for t in s.arrays().values()]
        before += [plain.detach().clone(), motion.detach().clone()]
        plain.grad = torch.full_like(plain, value)
        TORCH.adam_step(states[:1], [plain], 1e-2, 1e-15, torch.tensor(skip))
        gradient = RankOneGradient("motion", np.array([0, 0.5, 1, 0]), torch.full((5, 3), value))
        TORCH.adam_basis_step(states[1], motion, [gradient], np.full(3, 1e-2), 1e-15, torch.tensor(skip))
        after = [t for s in states for t in s.arrays().values()] + [plain.detach(), motion.detach()]
        same = [torch.equal(a, b) for a, b in zip(before, after, strict=True)]
        assert all(same) if skip else not any(same)


def test_fp16_planes_render_the_same_and_cannot_be_saved(tiny_sequence, tmp_path):
    trainer = GaussianTrainer(load_sequence(tiny_sequence), tiny_config("hexplane"))
    trainer.start()
    scene = trainer.scene()
    scene.save(tmp_path / "scene.safetensors")
    scene = load_scene(tmp_path / "scene.safetensors")
    half = scene.field.to("cpu", fp16_planes=True)
    assert half.grid.to(torch.device("cpu")).values.dtype == torch.float32, "a CPU looks up no half precision"
    assert half.grid.values.dtype == torch.float16 and not half.grid.grads.numel()
    with torch.no_grad():
        full, rounded = (f.offsets(scene.gaussians["means"], 0.4, TORCH.model).means for f in (scene.field, half))
    torch.testing.assert_close(rounded, full, rtol=1e-2, atol=1e-2 * float(full.abs().max()))
    with pytest.raises(ValueError, match="fp16"):
        replace(scene, field=half).save(tmp_path / "again.safetensors")
