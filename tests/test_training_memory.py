"""The memory a training needs: by hand for a small config, refused with both numbers, never refused without need."""

from __future__ import annotations

import pytest
from tiny_training import tiny_config

from endoprior.core.checks import InputError
from endoprior.data import load_sequence
from endoprior.model.presets import preset
from endoprior.runs.train import train
from endoprior.training import preflight as training_memory
from endoprior.training.preflight import MIN_BYTES, PICTURE_BYTES, least_bytes


def test_by_hand():
    cfg = tiny_config("basis").fitted(17)  # 300 Gaussians of degree 3
    per_gaussian = 3 + 4 + 3 + 1 + 3 * 16
    channels = 4 + 3 + 3 + cfg.deformation.deform_opacity
    basis = cfg.deformation.basis
    motion, changes, frame_motion = basis.num_bases * 3, basis.num_change_bases * channels, 17 * 3
    state = 3 * 4 * 300 * (per_gaussian + motion + changes) + 4 * 300 * frame_motion
    state += 2 * 4 * 300 * max(per_gaussian, motion, changes, frame_motion)
    assert least_bytes(cfg, 300, 15, 48, 40) - MIN_BYTES - PICTURE_BYTES * 48 * 40 >= state
    assert least_bytes(cfg, 300, 15, 48, 40) < MIN_BYTES + PICTURE_BYTES * 48 * 40 + 2 * state


@pytest.mark.parametrize("name", ["default", "paper", "released", "endogaussian"])
def test_more_of_anything_needs_no_less(name):
    cfg = preset(name).fitted(100)
    num = cfg.init.budget
    base = least_bytes(cfg, num, 100, 640, 512)
    assert least_bytes(cfg, num, 1000, 640, 512) >= base < least_bytes(cfg, num, 100, 1280, 1024)
    assert least_bytes(cfg, 2 * num, 100, 640, 512) > base
    assert 0.4e9 < base < 2.5e9


def test_too_little_is_refused_with_both_numbers_before_anything_is_made(tiny_sequence, tmp_path, monkeypatch):
    monkeypatch.setattr(training_memory, "available_bytes", lambda: 100_000_000)
    with pytest.raises(InputError) as refused:
        train(load_sequence(tiny_sequence), tiny_config("basis"), tmp_path / "run")
    text = str(refused.value)
    assert (
        str(tiny_sequence) in text and "0.1 GB free" in text and "at least 0.3 GB" in text and "--data.shrink" in text
    )
    assert not (tmp_path / "run").exists()
    with pytest.raises(InputError, match="48x40 px, at least"):  # no word on Gaussians, which it has not
        train(load_sequence(tiny_sequence), preset("endonerf"), tmp_path / "run")
    monkeypatch.setattr(training_memory, "available_bytes", lambda: None)  # a system that does not say
    train(load_sequence(tiny_sequence), tiny_config("basis", 1, 1))
