"""The definitions that run where no kernel does: on the CPU, without kernels, they train like the kernels."""

from __future__ import annotations

import numpy as np
import pytest
import torch
from test_train import tiny_config

from endoprior.compute import compiled as compiled_module
from endoprior.compute.compiled import compiled, definitions_only
from endoprior.data import load_sequence
from endoprior.training import temporal
from endoprior.training.trainer import Trainer

KINDS = ("basis", "hexplane")


def rows(folder, cfg, steps=20):
    """Sum of the loss and number of Gaussians of each iteration."""
    trainer = Trainer(load_sequence(folder), cfg)
    trainer.start()
    reports = [trainer.step() for _ in range(min(steps, 20))]
    return [(sum(r.terms.values()), r.num_gaussians) for r in reports], trainer


def test_the_switch_comes_back(monkeypatch):
    tensor = torch.zeros(1)
    assert compiled(tensor)
    with pytest.raises(ZeroDivisionError), definitions_only():
        assert not compiled(tensor)
        raise ZeroDivisionError
    assert compiled(tensor) and not compiled(torch.zeros(1, device="meta"))
    assert compiled_module._definitions_everywhere is False


@pytest.mark.parametrize("kind", KINDS)
def test_training_without_kernels_follows_training_with_them(tiny_sequence, kind):
    with_kernels, ours = rows(tiny_sequence, tiny_config(kind))
    with definitions_only():
        without, theirs = rows(tiny_sequence, tiny_config(kind))
    assert [r[0] for r in without] == pytest.approx([r[0] for r in with_kernels], rel=2e-3)
    assert [r[1] for r in without] == pytest.approx([r[1] for r in with_kernels], rel=0.02)
    if len(ours.state.gaussians) == len(theirs.state.gaussians):
        a, b = ours.state.gaussians["sh_dc"], theirs.state.gaussians["sh_dc"]
        assert float((a - b).detach().abs().mean()) < 0.02


@pytest.mark.parametrize("kind", KINDS)
def test_the_temporal_term_agrees(kind):
    generator = torch.Generator().manual_seed(1)
    before = torch.randn(200, 3, generator=generator) * 20
    now = (before + torch.randn(200, 3, generator=generator)).requires_grad_()
    weights = torch.from_numpy(np.random.default_rng(0).random(200).astype(np.float32))
    cfg = tiny_config(kind).temporal
    kernels = temporal.local_consistency(now, before, weights, cfg)
    (kernel_grad,) = torch.autograd.grad(sum(kernels), now)
    with definitions_only():
        definitions = temporal.local_consistency(now, before, weights, cfg)
        (grad,) = torch.autograd.grad(sum(definitions), now)
    torch.testing.assert_close(torch.stack(definitions), torch.stack(kernels), rtol=1e-4, atol=1e-6)
    torch.testing.assert_close(grad, kernel_grad, rtol=1e-3, atol=1e-6)
