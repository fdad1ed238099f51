"""Kernels come from the cache in every run: filled once by a process of its own, by what decides which there are."""

from __future__ import annotations

import importlib
import json
from dataclasses import replace
from types import SimpleNamespace

import pytest

from endoprior.core.config import OWN
from endoprior.core.config_io import to_dict
from endoprior.model.method import METHODS, method_named
from endoprior.model.presets import preset
from endoprior.runs import kernel_cache
from endoprior.runs.kernel_cache import shortened, tiny_sequence
from endoprior.training.gaussian_trainer import GaussianTrainer


class Process:
    """Takes the place of the process that compiles: reads the config, says that it compiled two kernels, and ends."""

    status, asked = 0, []

    def __init__(self, words, **_pipes):
        self.stdout = ["1\n", "a warning\n", "2\n"]
        self.stdin = SimpleNamespace(write=lambda text: self.asked.append(json.loads(text)), close=lambda: None)

    def __enter__(self):
        return self

    def __exit__(self, *_exc):
        pass

    def wait(self):
        return self.status

    def kill(self):
        pass


@pytest.fixture
def cold(tmp_path, monkeypatch):
    """An empty cache, and a list of the configs whose kernels were asked for; compiling succeeds at once."""
    monkeypatch.setenv("NUMBA_CACHE_DIR", str(tmp_path))
    monkeypatch.setattr(kernel_cache.subprocess, "Popen", Process)
    monkeypatch.setattr(Process, "status", 0)
    monkeypatch.setattr(Process, "asked", [])
    next_process()
    yield Process.asked
    next_process()


def next_process():
    """Forget what this process knows of the cache."""
    importlib.reload(kernel_cache)


def test_it_is_filled_once_for_what_needs_the_same_kernels(cold):
    asked = cold
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
    asked = cold
    paper = preset("paper")
    either_end = replace(paper, temporal=replace(paper.temporal, gradient="current"))
    for number, cfg in enumerate((preset("endogaussian"), paper, either_end), 1):
        kernel_cache.fill(cfg)
        assert len(asked) == number


def test_a_warm_up_that_fails_is_tried_again_by_the_next_process(cold, monkeypatch):
    asked = cold
    monkeypatch.setattr(Process, "status", 1)
    kernel_cache.fill(preset("default"))
    next_process()
    kernel_cache.fill(preset("default"))
    assert len(asked) == 2


def test_presets_that_differ_in_numbers_share_their_kernels(cold):
    for name in ("preview", "default", "best"):
        kernel_cache.fill(preset(name))
    own = preset("default")
    more = replace(own, deformation=replace(own.deformation, basis=replace(own.deformation.basis, num_bases=14)))
    kernel_cache.fill(replace(more, temporal=replace(more.temporal, weight=0.5)))
    assert len(cold) == 1
    kernel_cache.fill(replace(own, temporal=replace(own.temporal, weight=0.0)))
    assert len(cold) == 2


def test_a_change_where_no_kernel_is_used_keeps_them(cold, tmp_path, monkeypatch):
    package = tmp_path / "package"

    def fill_after_change(name):
        (package / name).parent.mkdir(parents=True, exist_ok=True)
        (package / name).write_text(name)
        next_process()
        monkeypatch.setattr(kernel_cache, "PACKAGE", package)
        kernel_cache.fill(preset("default"))
        return len(cold)

    assert [fill_after_change(name) for name in ("render/tiles.py", "cli/run.py", "training/step.py")] == [1, 1, 2]


def test_it_says_how_far_it_is(cold):
    seen = []
    assert not kernel_cache.is_filled(preset("default"))
    kernel_cache.fill(preset("default"), progress=lambda done, total: seen.append((done, total)))
    assert [done for done, _ in seen] == [1, 2] and all(total > done for done, total in seen)
    assert kernel_cache.is_filled(preset("default"))


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
