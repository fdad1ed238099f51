"""The phantom without its highlights, and the score of taking them out of a scene."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
import torch

from endoprior.data import load_sequence
from endoprior.evaluation.scorers import highlights as scorer
from endoprior.evaluation.scoring import evaluate
from endoprior.model.presets import preset
from endoprior.phantom import PhantomConfig, write_phantom
from endoprior.training.gaussian_trainer import GaussianTrainer

PHANTOM = PhantomConfig(frames=10, width=96, height=80, side_views=False)


@pytest.fixture(scope="module")
def sequence(tmp_path_factory):
    """A small phantom."""
    out = tmp_path_factory.mktemp("phantom") / "sequence"
    write_phantom(out, PHANTOM)
    return load_sequence(out)


def test_the_truth_without_highlights_lacks_light_on_wet_tissue_only(sequence) -> None:
    truth = sequence.truth
    assert truth.has_no_highlights
    for index in range(len(sequence)):
        dull = truth.no_highlights(index)
        assert (dull is not None) == (index in sequence.indices("test"))
        if dull is not None:
            added = truth.tissue(index).astype(int) - dull
            assert added.min() >= -1 and added.max() > 40 and np.median(added) < 5


@pytest.mark.parametrize("cfg", [replace(PHANTOM, tissue="smoke"), PhantomConfig("tube", 8, 96, 80)])
def test_no_such_truth_where_smoke_veils_it_or_of_tubes(tmp_path, cfg) -> None:
    write_phantom(tmp_path / "sequence", cfg)
    assert not load_sequence(tmp_path / "sequence").truth.has_no_highlights


def test_a_scene_that_shows_the_truth_without_highlights_has_that_score(sequence, monkeypatch) -> None:
    cfg = preset("default").replace({"init.motion": "rest", "gaussians": 300}).fitted(10)
    trainer = GaussianTrainer(sequence, cfg)
    trainer.start()
    scene, truth = trainer.scene(), sequence.truth
    off = {9: 0.1, 1: 0.2}

    class Dull:
        def render(self, time, camera):
            index = round(time * len(sequence))
            color = np.float32(truth.no_highlights(index) / 255)
            shifted = color + np.where(color < 0.5, 1, -1) * np.float32(off[index])
            return type("View", (), {"color": torch.from_numpy(shifted)})

    monkeypatch.setattr(scorer, "without_highlights", lambda given, frames_of: Dull())
    scores = evaluate(scene, sequence, networks=False).scores
    assert scores["psnr_no_highlights"] == pytest.approx(np.mean([-20 * np.log10(e) for e in off.values()]), abs=0.05)
    by_hand = []
    for frame in sequence.frames("test"):
        true = truth.no_highlights(frame.index)
        below = frame.tissue_mask & (truth.tissue(frame.index).mean(-1) - true.mean(-1) >= scorer.MIN_HIGHLIGHT_LEVELS)
        seen = (scene.render(frame.time, frame.camera).color.numpy() * 255 + 0.5).astype(np.uint8) / 255
        by_hand.append(-10 * np.log10(np.mean((seen - true / 255)[below] ** 2)))
    assert scores["psnr_highlights_kept"] == pytest.approx(np.mean(by_hand), abs=1e-3)


def test_colors_that_do_not_change_have_no_such_score(sequence) -> None:
    cfg = preset("paper").replace({"iterations": 2, "gaussians": 100}).fitted(10)
    trainer = GaussianTrainer(sequence, cfg)
    trainer.start()
    found = evaluate(trainer.scene(), sequence, networks=False)
    assert not {score.name for score in scorer.SCORES} & (found.scores.keys() | found.skipped.keys())
