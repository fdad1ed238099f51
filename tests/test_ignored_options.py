"""Options that a method would ignore are errors, or a note where benchmarks of the past contain them."""

from __future__ import annotations

from dataclasses import replace

import pytest

from endoprior.core.checks import InputError
from endoprior.core.config import WindowConfig
from endoprior.data import load_sequence
from endoprior.model.method import METHODS, method_named
from endoprior.model.presets import preset, preset_names
from endoprior.runs.train import start_run
from endoprior.training.gaussian_trainer import GaussianTrainer
from endoprior.training.preflight import first_count, note_on_budget, reject_ignored_options

WITHOUT_PRIOR = [name for name in METHODS.names() if not getattr(method_named(name), "uses_prior", True)]
FIELDS = [name for name in METHODS.names() if not method_named(name).has_gaussians]
OF_PIXELS = ["deform3dgs", "endo4dgs", "surgicalgaussian"]
"""Methods that start from the pixels of frames, not from `init.budget`."""


def start(folder, cfg, said=None):
    """What a run does before it computes."""
    return start_run(load_sequence(folder, cfg.data), cfg, say=(said if said is not None else []).append)


@pytest.mark.parametrize("name", preset_names())
def test_no_preset_sets_an_option_that_its_method_ignores(name):
    reject_ignored_options(preset(name))
    assert note_on_budget(preset(name)) is None


@pytest.mark.parametrize(
    ("name", "option", "value"),
    [(name, "temporal.weight", 1e-3) for name in WITHOUT_PRIOR] + [(name, "data.eyes", "both") for name in FIELDS],
)
def test_what_a_method_ignores_is_an_error_before_anything_is_computed(tiny_sequence, name, option, value):
    assert len(WITHOUT_PRIOR) == 4 and len(FIELDS) == 2
    with pytest.raises(InputError, match=f"{option}: expected .* with method {name}, .* got {value}. Fix: ") as caught:
        start(tiny_sequence, preset(name).replace({option: value}))
    assert "\n" not in str(caught.value)


@pytest.mark.parametrize("name", FIELDS)
def test_a_radiance_field_has_one_window(make_tiny_sequence, name):
    folder = make_tiny_sequence(num_frames=12, width=10, height=8)
    for longest in (12, 6):
        windows = WindowConfig(longest=longest)
        cfg = replace(preset(name, iterations=1), windows=windows)
        if longest == 12:
            start(folder, cfg)
        else:
            with pytest.raises(InputError, match=rf"windows\.longest: expected 0 with method {name}.*longest 0"):
                start(folder, cfg)


@pytest.mark.parametrize("name", [*OF_PIXELS, *FIELDS])
def test_a_number_of_gaussians_without_effect_is_a_note(name):
    note = note_on_budget(preset(name, gaussians=5000))
    assert note and note.startswith("init.budget") and name in note


def test_the_note_is_said(tiny_sequence):
    said = []
    start(tiny_sequence, preset("deform3dgs", gaussians=5000), said)
    assert [line for line in said if line.startswith("note: init.budget") and "deform3dgs" in line]


def test_a_number_of_gaussians_with_an_effect_is_no_note():
    assert all(note_on_budget(preset(name, gaussians=5000)) is None for name in ("default", "paper", "endogs"))


@pytest.mark.parametrize("name", OF_PIXELS)
def test_the_first_gaussians_are_counted_as_the_method_starts(tiny_sequence, name):
    sequence, cfg = load_sequence(tiny_sequence), preset(name)
    trainer = GaussianTrainer(sequence, cfg)
    trainer.start()
    assert 0.5 * len(trainer.state.gaussians) < first_count(sequence, cfg) <= 1.2 * len(trainer.state.gaussians)


def test_the_budget_counts_for_others_and_fields_have_none(tiny_sequence):
    sequence = load_sequence(tiny_sequence)
    assert [first_count(sequence, preset(name, gaussians=777)) for name in ("default", "endogs", *FIELDS)] == [
        777, 777, 0, 0,
    ]  # fmt: skip
