"""A run that goes wrong stops before it harms its state, says why, and keeps what it had."""

from __future__ import annotations

from dataclasses import replace
from functools import partial

import numpy as np
import pytest
import torch
from hexplane_grids import planes
from tiny_training import KINDS, tiny_config

from endoprior.data import load_sequence
from endoprior.model.hexplane import FRESH, TOUCHED, PlaneGrid
from endoprior.model.presets import preset
from endoprior.model.scene_file import load_scene
from endoprior.runs.train import train
from endoprior.training import divergence
from endoprior.training.divergence import (
    CHECK_EVERY,
    MAX_GRADIENT,
    WINDOW,
    Diverged,
    DivergenceCheck,
    Watch,
    unusable_numbers,
)
from endoprior.training.gaussian_trainer import GaussianTrainer
from endoprior.training.losses import color_l1
from endoprior.training.ops import NUMBA, TORCH
from endoprior.training.optimizer import Optimizer, rate_of
from endoprior.training.own_method import OwnMethod

BAD = [float("nan"), float("inf"), -float("inf"), 2 * MAX_GRADIENT, -1e30]


@pytest.mark.parametrize("ops", [NUMBA, TORCH], ids=lambda ops: ops.model.name)
def test_unusable_entries_are_counted(ops):
    for shape in [(0,), (1,), (7,), (100, 3), (5, 16, 3)]:
        values = torch.randn(shape, generator=torch.Generator().manual_seed(0))
        assert ops.count_unusable(values, MAX_GRADIENT) == 0
        flat = values.reshape(-1)
        count = min(len(BAD), len(flat))
        flat[:count] = torch.tensor(BAD[:count])
        assert ops.count_unusable(values, MAX_GRADIENT) == count


def test_cells_without_a_new_gradient_do_not_count():
    grid = PlaneGrid(planes((2, 2, 2), 2, 3, (1,)))
    grid.grads[:3], grid.marks[:4] = float("nan"), torch.tensor([0, TOUCHED, TOUCHED | FRESH, FRESH])
    assert NUMBA.count_unusable_in_planes(grid, MAX_GRADIENT) == 3


def test_unusable_numbers_are_named():
    assert unusable_numbers({"color": 0.1}, {"means": 0}) is None
    for value in BAD[:3]:
        assert "got color" in unusable_numbers({"color": value}, {"means": 0})
    assert "3 unusable entries in the gradient of means" in unusable_numbers({"color": 0.1}, {"means": 3, "quats": 0})


def test_images_no_better_than_black_are_noticed_and_dark_ones_are_not():
    good, dark, lost = Watch(), Watch(), Watch()
    for _ in range(3 * WINDOW):
        assert good.see(0.3, 0.4) is None and dark.see(0.01, 0.01) is None
    for _ in range(WINDOW - 1):
        assert lost.see(0.4, 0.4) is None
    assert "background alone" in lost.see(0.4, 0.4)
    learning = Watch()
    for step in range(3 * WINDOW):
        assert learning.see(3.0 if step < WINDOW // 2 else 0.1, 0.4) is None, "a bad start is no divergence"


def quiet(kind="basis", fine=200):
    """A config without density events, at which a device is checked at once."""
    cfg = tiny_config(kind, coarse=0, fine=fine)
    return replace(cfg, density=replace(cfg.density, start_iteration=10**6))


def started(folder, cfg):
    """A trainer before its first iteration."""
    trainer = GaussianTrainer(load_sequence(folder), cfg)
    trainer.start()
    return trainer


@pytest.mark.parametrize(
    "name", ["default", "deform3dgs", pytest.param("endogs", marks=pytest.mark.slow), "endo4dgs", "surgicalgaussian"]
)
def test_every_method_is_watched_by_its_error_on_tissue(tiny_sequence, name, monkeypatch):
    """Whatever unit and region its own color term has; and an image of nothing but background ends the run."""
    monkeypatch.setattr(divergence, "WINDOW", 4)
    monkeypatch.setattr(divergence, "PARTS", 1)
    small = planes((6, 5, 4), 7, 3, (1, 2))
    cfg = preset(name, iterations=9)
    cfg = replace(
        cfg,
        schedule=replace(cfg.schedule, coarse_iterations=0, half_resolution_iterations=0),
        deformation=replace(cfg.deformation, hexplane=small),
    )
    trainer = started(tiny_sequence, cfg)
    forward = trainer.step_once.forward(trainer.state, np.random.default_rng(0))
    expected = float(color_l1(forward.out.color.detach(), forward.frame.rgb, forward.frame.tissue_mask))
    _, error = trainer.step_once.loss(trainer.state, forward)
    assert float(error.detach()) == pytest.approx(expected, rel=1e-5)
    with torch.no_grad():
        trainer.state.gaussians["opacity_logits"].fill_(-40)
    for _ in range(3):
        trainer.step()
    with pytest.raises(Diverged, match="background alone"):
        trainer.step()
    assert trainer.state.iteration == 3


def state_of(trainer):
    """Every number that a checkpoint would hold; of the planes' moments only those that are not 0.

    Cells that only the dropped gradient reached stay marked: their moments are zero, and zero is where they stay.
    """
    state = trainer.state
    arrays = dict(state.gaussians.tensors) | state.stats.tensors()
    moments = state.optimizer.state_arrays()
    if state.field is not None:
        moments["plane_adam.exp_avg"] = moments["plane_adam.exp_avg"][moments["plane_adam.exp_avg"] != 0]
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


@pytest.mark.parametrize("kind", ["basis", pytest.param("hexplane", marks=pytest.mark.slow)])
def test_an_unusable_gradient_stops_before_anything_changes(tiny_sequence, kind):
    trainer = started(tiny_sequence, tiny_config(kind, fine=40))
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
    trainer = started(tiny_sequence, tiny_config("hexplane"))
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


@pytest.mark.slow
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


def test_a_run_that_lost_every_gaussian_can_be_read_again(tiny_sequence, tmp_path):
    cfg = tiny_config("basis", coarse=0)
    cfg = replace(cfg, density=replace(cfg.density, prune_opacity=1.0, start_iteration=0, every=5))
    with pytest.raises(Diverged, match=r"after iteration 5 .*removed"):
        train(load_sequence(tiny_sequence), cfg, tmp_path / "run")
    steps = []
    with pytest.raises(Diverged, match=r"after iteration 10 .*removed"):
        train(load_sequence(tiny_sequence), cfg, tmp_path / "run", resume=True, on_step=lambda r, _: steps.append(r))
    assert [report.iteration for report in steps] == [6, 7, 8, 9]


def test_steps_of_adam_are_bounded_as_the_guard_assumes():
    """The worst gradients for Adam: those that grow as Cauchy and Schwarz's equality asks, after a long silence."""
    moments, largest, last = np.zeros(2), 0.0, 3999
    for t in range(1, last + 1):
        g = 1e15 * (0.9 / 0.999) ** (last - t)
        moments = np.array([0.9, 0.999]) * moments + np.array([0.1 * g, 0.001 * g * g])
        corrected = moments / (1 - np.array([0.9, 0.999]) ** t)
        largest = max(largest, corrected[0] / (np.sqrt(corrected[1]) + 1e-15))
    assert 7.2 < largest < 7.3


def as_on_a_device(trainer):
    """Have a started trainer check its iterations as it does on a device: now and then."""
    trainer.step_once.ops = TORCH
    trainer.step_once.check = DivergenceCheck(torch.device("cpu"), blocking=False)
    state = trainer.state
    rate = partial(rate_of, cfg=trainer.cfg, spatial_scale=trainer.spatial_scale)
    state.optimizer = Optimizer(state.gaussians, state.field, trainer.cfg, rate, TORCH)
    return trainer


@pytest.mark.parametrize("kind", KINDS)
@pytest.mark.parametrize("name", ["means", pytest.param("opacity_logits", marks=pytest.mark.slow)])
def test_a_late_check_finds_the_state_before_a_bad_gradient(tiny_sequence, kind, name):
    trainer = as_on_a_device(started(tiny_sequence, quiet(kind)))
    for _ in range(8):
        trainer.step()
    trainer.synchronize()
    before = state_of(trainer)
    handle = poison(trainer, name, float("nan"))
    with pytest.raises(Diverged, match=f"gradient of {name}"):
        for _ in range(CHECK_EVERY):
            trainer.step()
    after = state_of(trainer)
    assert trainer.state.iteration == 8
    assert all(torch.equal(before[key], after[key]) for key in before)
    handle.remove()
    trainer.step()  # and it could go on
    assert not torch.equal(state_of(trainer)["sh_dc"], before["sh_dc"])


def test_a_reset_of_opacities_waits_for_the_check(tiny_sequence, monkeypatch):
    monkeypatch.setattr(OwnMethod, "reset_due", lambda self, stage, iteration, cfg: iteration == 3)
    trainer = as_on_a_device(started(tiny_sequence, quiet()))
    for _ in range(2):
        trainer.step()
    before = state_of(trainer)
    poison(trainer, "means", float("nan"))
    with pytest.raises(Diverged, match="gradient of means"):
        trainer.step()
    after = state_of(trainer)
    assert trainer.state.iteration == 2 and all(torch.equal(before[key], after[key]) for key in before)


def test_the_last_iteration_and_a_checkpoint_wait_for_the_check(tiny_sequence):
    for ending in (GaussianTrainer.step, GaussianTrainer.synchronize):
        trainer = as_on_a_device(started(tiny_sequence, quiet(fine=2)))
        poison(trainer, "means", float("nan"))
        assert trainer.step().iteration == 1
        with pytest.raises(Diverged):
            ending(trainer)
        assert trainer.state.iteration == 0


def test_a_run_folder_keeps_the_scene_before_a_late_check(tiny_sequence, tmp_path):
    def spoil(report, trainer):
        if report.iteration == 1:
            as_on_a_device(trainer)
        if report.iteration == 9:
            poison(trainer, "quats", float("nan"))

    with pytest.raises(Diverged, match=r"fine iteration 10: .*last_good"):
        train(load_sequence(tiny_sequence), quiet(fine=60), tmp_path / "run", on_step=spoil)
    scene = load_scene(tmp_path / "run" / "last_good.safetensors")
    assert all(bool(value.isfinite().all()) for value in scene.gaussians.tensors.values())
