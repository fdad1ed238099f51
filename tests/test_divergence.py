"""A run that goes wrong stops before it harms its state, says why, and keeps what it had."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
import torch
from tiny_training import KINDS, tiny_config

from endoprior.core.checks import InputError
from endoprior.data import load_sequence
from endoprior.model.scene import load_scene
from endoprior.runs.training_run import train
from endoprior.training.divergence import (
    LARGEST_GRADIENT,
    WINDOW,
    Diverged,
    Watch,
    check_step,
    count_unusable,
    count_unusable_rows,
)
from endoprior.training.trainer import Trainer


@pytest.mark.parametrize("shape", [(0,), (1,), (7,), (100, 3), (5, 16, 3)])
def test_unusable_entries_are_counted(shape):
    generator = torch.Generator().manual_seed(0)
    values = torch.randn(shape, generator=generator)
    assert count_unusable(values) == 0
    flat = values.reshape(-1)
    bad = [float("nan"), float("inf"), -float("inf"), 2 * float(LARGEST_GRADIENT), -1e30]
    for i in range(min(len(bad), len(flat))):
        flat[i] = bad[i]
    assert count_unusable(values) == min(len(bad), len(flat))


def test_rows_without_the_mark_do_not_count():
    values = torch.full((4, 3), float("nan"))
    values[3] = 1
    marks = torch.tensor([0, 1, 3, 2], dtype=torch.uint8)
    assert count_unusable_rows(values, marks, 2) == 3


@pytest.mark.parametrize("value", [float("nan"), float("inf"), -float("inf")])
def test_a_loss_without_a_value_is_refused_by_name(value):
    check_step({"color": 0.1}, {"means": 0})
    with pytest.raises(Diverged, match="color"):
        check_step({"color": value}, {"means": 0})
    with pytest.raises(Diverged, match="3 unusable entries in the gradient of means"):
        check_step({"color": 0.1}, {"means": 3, "quats": 0})


def test_pictures_no_better_than_black_are_noticed_and_dark_ones_are_not_judged():
    good, dark, lost = Watch(), Watch(), Watch()
    for _ in range(3 * WINDOW):
        good.see(0.3, 0.4)
        dark.see(0.01, 0.01)
    for _ in range(WINDOW - 1):
        lost.see(0.4, 0.4)
    with pytest.raises(Diverged, match="black"):
        lost.see(0.4, 0.4)


def state_of(trainer):
    """Every number that a checkpoint would hold; of the planes' moments only how far they are.

    Cells that only the dropped gradient reached stay marked: their moments are zero, and zero is where they stay.
    """
    state = trainer.state
    arrays = dict(state.gaussians.tensors) | state.stats.tensors()
    moments = state.optimizer.state_arrays()
    if state.field is not None:
        moments["plane_adam.exp_avg"] = moments["plane_adam.exp_avg"].abs().sum(dtype=torch.float64)
        del moments["plane_adam.marks"], moments["plane_adam.exp_avg_sq"]
    arrays |= moments
    if state.field is not None:
        arrays |= state.field.state_arrays()
    return {name: value.detach().clone() for name, value in arrays.items()}


def poison(trainer, name, value):
    """Make the next gradient of one parameter unusable."""

    def spoil(grad):
        spoiled = grad.clone()
        spoiled.reshape(-1)[0] = value
        return spoiled

    return trainer.state.gaussians[name].register_hook(spoil)


@pytest.mark.parametrize("kind", KINDS)
def test_an_unusable_gradient_stops_before_anything_changes(tiny_sequence, kind):
    trainer = Trainer(load_sequence(tiny_sequence), tiny_config(kind, fine=40))
    trainer.start()
    for _ in range(8):
        trainer.step()
    for name in ("means", "quats", "log_scales", "opacity_logits", "sh_dc"):
        for value in (float("nan"), float("inf"), 1e20):
            before, iteration = state_of(trainer), trainer.state.iteration
            handle = poison(trainer, name, value)
            with pytest.raises(Diverged, match=f"gradient of {name}"):
                trainer.step()
            after = state_of(trainer)
            assert trainer.state.iteration == iteration
            assert all(torch.equal(before[key], after[key]) for key in before), (name, value)
            handle.remove()
            trainer.step()  # and it could go on
            assert all(bool(values.isfinite().all()) for values in state_of(trainer).values()), (name, value)


def test_a_poisoned_plane_is_noticed(tiny_sequence):
    trainer = Trainer(load_sequence(tiny_sequence), tiny_config("hexplane"))
    trainer.start()
    while trainer.state.iteration < 8 or trainer.state.stage == 0:
        trainer.step()
    trainer.state.field.grid.marks[:1] = 3
    trainer.state.field.grid.grads[0, 0] = float("nan")
    with pytest.raises(Diverged, match="gradient of planes"):
        trainer.step()


def rates(cfg, factor):
    optim = cfg.optim
    names = [name for name in vars(optim) if name.endswith(("_lr", "_lr_final"))]
    return replace(cfg, optim=replace(optim, **{name: min(factor * getattr(optim, name), 1e3) for name in names}))


@pytest.mark.parametrize("kind", KINDS)
def test_learning_rates_a_million_times_too_high_end_in_words(tiny_sequence, tmp_path, kind):
    cfg = rates(tiny_config(kind, coarse=50, fine=2000), 1e6)
    with pytest.raises(Diverged) as stopped:
        train(load_sequence(tiny_sequence), cfg, tmp_path / "run")
    text = str(stopped.value)
    assert text.startswith(str(tmp_path / "run")) and "iteration" in text and "--optim" in text and "\n" not in text
    kept = load_scene(tmp_path / "run" / "last_good.safetensors")
    assert all(bool(value.isfinite().all()) for value in kept.gaussians.tensors.values())
    assert not (tmp_path / "run" / "scene.safetensors").exists()
    with pytest.raises(Diverged):  # going on meets the same, and loses nothing
        train(load_sequence(tiny_sequence), cfg, tmp_path / "run", resume=True)


def test_a_scene_that_loses_every_gaussian_stops(tiny_sequence):
    cfg = tiny_config("basis")
    cfg = replace(cfg, density=replace(cfg.density, prune_opacity=1.0, start_iteration=0, every=5))
    with pytest.raises(InputError, match="faded"):
        train(load_sequence(tiny_sequence), cfg)


def test_steps_of_adam_are_bounded_as_the_guard_assumes():
    """The worst gradients for Adam: those that grow as Cauchy and Schwarz's equality asks, after a long silence."""
    moments, largest, last = np.zeros(2), 0.0, 3999
    for t in range(1, last + 1):
        g = 1e15 * (0.9 / 0.999) ** (last - t)
        moments = np.array([0.9, 0.999]) * moments + np.array([0.1 * g, 0.001 * g * g])
        corrected = moments / (1 - np.array([0.9, 0.999]) ** t)
        largest = max(largest, corrected[0] / (np.sqrt(corrected[1]) + 1e-15))
    assert 7.2 < largest < 7.3
