"""Relative depth: the line that fits it to the rendered depth, and what a training makes of frames that disagree."""

from __future__ import annotations

from dataclasses import replace
from types import SimpleNamespace

import numpy as np
import pytest
import torch
from tiny_training import tiny_config

from endoprior.data import load_sequence
from endoprior.runs.checkpoint import load_checkpoint, save_checkpoint
from endoprior.training.depth_fit import LEAST_PIXELS, MOMENTUM, at_start, fitted, line, update
from endoprior.training.frames import TrainingFrame
from endoprior.training.gaussian_trainer import GaussianTrainer

HEIGHT, WIDTH = 60, 80


def frame_of(inverse: torch.Tensor) -> TrainingFrame:
    measured = inverse > 0
    picture = torch.zeros((*inverse.shape, 3), dtype=torch.uint8)
    return TrainingFrame(0, 0.0, None, picture, measured, ~measured, inverse, measured, int(measured.sum()), 0.5)


def depth_like(scale: float, shift: float) -> tuple[TrainingFrame, SimpleNamespace]:
    """A measured frame and a rendered one, so that scale * measured + shift = rendered inverse depth."""
    rendered = 1 / (60 + 20 * torch.rand((HEIGHT, WIDTH), generator=torch.Generator().manual_seed(0)))
    measured = (rendered - shift) / scale
    measured[:5] = 0
    alpha = torch.full_like(rendered, 0.95)
    return frame_of(measured), SimpleNamespace(alpha=alpha, depth=alpha / rendered)


def test_the_line_ignores_outliers():
    x = torch.linspace(0.01, 0.03, 500, dtype=torch.float64)
    y = 1.2 * x - 0.001
    y[::9] += 0.05
    np.testing.assert_allclose(line(x, y), [1.2, -0.001], atol=1e-4, rtol=1e-3)
    assert torch.isfinite(line(torch.ones(10, dtype=torch.float64), y[:10])).all(), "flat depth has no slope"


def test_repeated_fits_find_scale_and_shift_and_keep_the_scale_of_the_scene():
    fits = at_start(2)
    frames = [depth_like(1.25, 0.0005), depth_like(0.8, -0.0002)]
    for _ in range(60):
        for position, (frame, out) in enumerate(frames):
            update(fits, position, frame, out)
    np.testing.assert_allclose(fits[:, 0], [1.25, 0.8], rtol=1e-2)
    assert fits[:, 0].log().mean() == pytest.approx(0, abs=1e-9)
    frame, out = frames[0]
    rendered = out.alpha / out.depth
    shown = fitted(frame, fits[0]).inverse_depth
    torch.testing.assert_close(shown[5:], rendered[5:], rtol=1e-2, atol=0)
    assert (shown[:5] == 0).all(), "what is not measured stays so"


def test_one_step_goes_a_share_of_the_way_and_too_few_pixels_none():
    fits = at_start(1)
    frame, out = depth_like(1.0, 0.001)
    update(fits, 0, frame, out)
    assert float(fits[0, 1]) == pytest.approx(MOMENTUM * 0.001, rel=0.05)
    before = fits.clone()
    few = torch.zeros((HEIGHT, WIDTH))
    few.flatten()[: 7 * (LEAST_PIXELS - 1) : 7] = 0.01
    update(fits, 0, frame_of(few), out)
    assert torch.equal(fits, before)


@pytest.fixture
def relative(make_tiny_sequence):
    """Trainers of a sequence whose depth is relative."""
    sequence = load_sequence(make_tiny_sequence(width=144, height=120))
    sequence.depth_is_relative = True
    cfg = tiny_config("basis")
    cfg = replace(cfg, init=replace(cfg.init, opacity=0.95, budget=2000))  # so that it renders something solid
    return lambda fit: GaussianTrainer(sequence, replace(cfg, loss=replace(cfg.loss, fit_relative_depth=fit)))


def test_only_relative_depth_is_fitted(relative, make_tiny_sequence):
    trainer = relative(True)
    metric = GaussianTrainer(load_sequence(make_tiny_sequence("metric")), trainer.cfg)
    assert trainer.fits_depth and not metric.fits_depth and not relative(False).fits_depth


def test_a_checkpoint_holds_the_fits(relative, tmp_path):
    trainer = relative(True)
    trainer.start()
    for _ in range(16):
        trainer.step()
    assert (trainer.state.depth_fit != at_start(len(trainer.state.depth_fit))).any()
    save_checkpoint(trainer, tmp_path / "state", "0")
    again = relative(True)
    load_checkpoint(again, tmp_path / "state", "0")
    assert torch.equal(again.state.depth_fit, trainer.state.depth_fit)
    for _ in range(4):
        trainer.step(), again.step()
    assert torch.equal(again.state.depth_fit, trainer.state.depth_fit)
    assert torch.equal(again.state.gaussians["means"], trainer.state.gaussians["means"])
