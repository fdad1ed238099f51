"""Kernels come from the cache in every run: filled once by a process of its own, by what decides which there are."""

from __future__ import annotations

import importlib
import json
import subprocess
from dataclasses import replace

import pytest

from endoprior.core.config import OWN
from endoprior.core.config_io import to_dict
from endoprior.model.method import METHODS, method_named
from endoprior.model.presets import preset
from endoprior.runs import kernel_cache
from endoprior.runs.kernel_cache import shortened, tiny_sequence
from endoprior.training.gaussian_trainer import GaussianTrainer


@pytest.fixture
def cold(tmp_path, monkeypatch):
    """An empty cache, and a list of the warm-ups that were asked for; they succeed at once."""
    asked = []

    def instead(words, **options):
        asked.append(json.loads(options["input"]))
        return subprocess.CompletedProcess(words, instead.status, "", "")

    instead.status = 0
    monkeypatch.setenv("NUMBA_CACHE_DIR", str(tmp_path))
    monkeypatch.setattr(kernel_cache.subprocess, "run", instead)
    next_process()
    yield asked, instead
    next_process()


def next_process():
    """Forget what this process knows of the cache."""
    importlib.reload(kernel_cache)


def test_it_is_filled_once_for_what_needs_the_same_kernels(cold):
    asked, _ = cold
    cfg, said = preset("default"), []
    kernel_cache.fill(cfg, said.append)
    kernel_cache.fill(replace(cfg, seed=7, init=replace(cfg.init, budget=99)), said.append)
    assert asked == [json.loads(json.dumps(to_dict(cfg)))] and len(said) == 1
    next_process()
    kernel_cache.fill(cfg, said.append)
    assert len(asked) == 1 and len(said) == 1
    kernel_cache.fill(preset("paper"), said.append)
    assert len(asked) == 2


def test_the_temporal_term_has_kernels_of_its_own(cold):
    asked, _ = cold
    paper = preset("paper")
    either_end = replace(paper, temporal=replace(paper.temporal, gradient="current"))
    for number, cfg in enumerate((preset("endogaussian"), paper, either_end), 1):
        kernel_cache.fill(cfg)
        assert len(asked) == number


def test_a_warm_up_that_fails_is_tried_again_by_the_next_process(cold):
    asked, instead = cold
    instead.status = 1
    kernel_cache.fill(preset("default"))
    next_process()
    kernel_cache.fill(preset("default"))
    assert len(asked) == 2


OTHERS = [name for name in METHODS.names() if name != OWN and method_named(name).has_gaussians]


@pytest.mark.parametrize(
    "name",
    [
        "default",
        "paper",
        *(pytest.param(each, marks=pytest.mark.slow) for each in ("released", "endogaussian", *OTHERS)),
    ],
)
def test_the_warm_up_reaches_every_part_of_a_preset(name):
    cfg = shortened(preset(name))
    trainer = GaussianTrainer(tiny_sequence(), cfg)
    trainer.start()
    reports = []
    while not trainer.finished:
        reports.append(trainer.step())
    assert len({report.num_gaussians for report in reports}) > 1
    regularized = cfg.temporal.weight > 0 or name == "surgicalgaussian"  # which has a term of that name in its loss
    assert any("distance" in report.terms for report in reports) == regularized


def test_the_warm_up_needs_no_right_eye():
    cfg = preset("default")
    warm = shortened(replace(cfg, data=replace(cfg.data, eyes="both")))
    GaussianTrainer(tiny_sequence(), warm).start()
