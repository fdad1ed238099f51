"""Configs: the paper's numbers, strict JSON, presets, command-line agreement."""

import dataclasses
import functools
import json
from importlib import import_module
from pathlib import Path

import pytest

from endoprior.cli.train import Train
from endoprior.core import config_io
from endoprior.core.checks import InputError
from endoprior.core.config import Config
from endoprior.core.config_deformation import BasisConfig, DeformationConfig, HexPlaneConfig
from endoprior.core.config_io import from_dict, to_dict
from endoprior.model.gaussians import temporal_shapes
from endoprior.model.method import method_of
from endoprior.model.presets import preset, preset_names
from endoprior.training.gaussian_trainer import spatial_scale

PAPER_VALUES = json.loads((Path(__file__).parent / "paper_values.json").read_text())
PRESETS = ("default", "best", "paper", "released", "endogaussian")


@pytest.mark.parametrize("name", sorted(PAPER_VALUES))
def test_preset_and_constants_are_the_papers(name):
    """Names in capitals are constants of modules, the others fields."""
    path, _, last = name.rpartition(".")
    if last.isupper():
        value = getattr(import_module(f"endoprior.{path}"), last)
    else:
        value = functools.reduce(getattr, name.split("."), preset("paper"))
    assert value == PAPER_VALUES[name]


@pytest.mark.parametrize("name", PRESETS)
def test_config_survives_json(name):
    cfg = preset(name)
    assert from_dict(Config, json.loads(json.dumps(to_dict(cfg)))) == cfg


def test_missing_fields_keep_their_defaults():
    assert from_dict(Config, {"seed": 7}) == dataclasses.replace(Config(), seed=7)


@pytest.mark.parametrize(
    ("values", "names"),
    [
        ({"sed": 1}, "config.sed"),
        ({"density": {"evry": 1}}, "config.density.evry"),
        ({"seed": "1"}, "config.seed"),
        ({"seed": True}, "config.seed"),
        ({"seed": None}, "config.seed"),
        ({"temporal": {"gradient": "none"}}, "config.temporal.gradient"),
        ({"deformation": {"hexplane": {"multires": [1, "2"]}}}, "config.deformation.hexplane.multires[1]"),
        ({"init": {"budget": 0}}, "config.init"),
        ({"windows": {"longest": 3}}, "config.windows"),
        ({"density": {"min_densify_weight": float("nan")}}, "config.density.min_densify_weight"),
        ({"density": {"min_densify_weight": 2}}, "config.density"),
        ([], "config"),
    ],
)
def test_bad_configs_are_named(values, names):
    with pytest.raises(InputError) as caught:
        from_dict(Config, values)
    assert str(caught.value).startswith(names + ":") and "\n" not in str(caught.value)


def test_unknown_preset():
    with pytest.raises(InputError, match="preset: expected one of default, best, paper"):
        preset("finest")


def test_the_preset_default_is_that_of_the_class():
    assert preset("default") == Config()


def test_there_are_at_most_74_fields():
    # The last four: publications take all frames; whether a clip shows smoke is measured, and that can be wrong;
    # each compared method is shown as released and fitted to the clip; a scene knows its number of frames.
    assert len(dict(leaves(to_dict(Config())))) <= 74


def test_baseline_knows_no_prior():
    cfg = preset("endogaussian")
    assert cfg.init.sampler == "pool" and cfg.temporal.weight == 0 and cfg.density.min_densify_weight == 1


def test_only_tuples_lists_and_plain_values_are_configured():
    assert to_dict(HexPlaneConfig())["multires"] == [1, 2, 4, 8]
    assert to_dict(DeformationConfig())["deform_shape"] is True


def test_basis_functions_follow_the_length_of_the_sequence():
    fitted = [BasisConfig().fitted(n) for n in (2, 5, 24, 48, 63, 156)]
    assert [basis.num_bases for basis in fitted] == [4, 5, 15, 27, 35, 81]
    assert [basis.num_change_bases for basis in fitted] == [4, 4, 7, 12, 15, 32]
    assert [basis.num_frames for basis in fitted] == [2, 5, 24, 48, 63, 156]
    assert BasisConfig(num_bases=31).fitted(24) == BasisConfig(31, 24)
    fitted = preset("default").fitted(48)
    assert fitted.deformation.basis.num_bases == 27 and fitted.fitted(99) == fitted
    with pytest.raises(ValueError, match="num_bases: expected at least 4"):
        temporal_shapes(preset("default"))


@pytest.mark.parametrize("name", ["endogaussian", "paper", "released", "endogs", "endo4dgs"])
def test_planes_fitted_to_the_clip_have_as_many_cells_a_frame_in_the_half_that_times_use(name):
    cfg = preset(name, fit_to_clip=True)
    for frames in (24, 48, 156):
        fitted = method_of(cfg).fitted(cfg, frames)
        assert (fitted.deformation.hexplane.time_resolution - 1) / 2 / frames == pytest.approx(0.4, abs=0.25 / frames)
        assert method_of(cfg).fitted(fitted, frames) == fitted, "so that a run resumes"
    as_released = preset(name)
    assert method_of(cfg).fitted(as_released, 24).deformation.hexplane == as_released.deformation.hexplane


@pytest.mark.parametrize(("extent", "released", "fitted"), [(0.0, 10, 10), (6.0, 6, 6), (60.0, 60, 10)])
def test_rates_that_are_lengths_are_fitted_to_a_camera_that_goes_far(extent, released, fitted):
    assert spatial_scale(extent, fit_to_clip=False) == released
    assert spatial_scale(extent, fit_to_clip=True) == fitted


def test_a_run_fitted_to_the_clip_cannot_be_extended():
    with pytest.raises(InputError, match="--fit-to-clip takes shares"):
        preset("endogs", fit_to_clip=True).extended(9000)


def test_replaced_fields_are_set_and_the_others_stay():
    cfg = preset("default")
    changed = cfg.replace({"seed": 3, "optim.means_lr": 2e-3, "init.budget": "x0.5"})
    assert (changed.seed, changed.optim.means_lr, changed.init.budget) == (3, 2e-3, cfg.init.budget // 2)
    assert changed.replace({"seed": cfg.seed, "optim.means_lr": cfg.optim.means_lr, "init.budget": "x2"}) == cfg


def test_short_names_are_those_of_the_command_line():
    cfg = preset("default").replace({"iterations": 7, "gaussians": "x0.5"})
    assert (cfg.schedule.fine_iterations, cfg.init.budget) == (7, 15_000)
    assert preset("default", iterations=7, gaussians=15_000) == cfg
    assert Train.from_words(["--iterations", "7", "--gaussians", "15000", "d", "o"]).config == cfg
    assert all(f"--{name}".replace("_", "-") in Train.short for name in config_io.SHORT_NAMES)


@pytest.mark.parametrize(
    ("words", "factor"), [(["--eyes", "both"], 2), (["--data.eyes=both"], 2), (["--eyes", "left"], 1)]
)
def test_both_eyes_train_twice_as_long_unless_told_how_long(words, factor):
    whole = preset("default").schedule.total
    found = Train.from_words([*words, "d", "o"]).config
    assert found.schedule.total == factor * whole and found.optim.decay_iterations == factor * whole
    assert Train.from_words([*words, "--iterations", "70", "d", "o"]).config.schedule.total == 70
    literal = Train.from_words([*words, "--preset", "paper", "d", "o"]).config
    assert literal.schedule == preset("paper").schedule


def test_another_length_keeps_the_shares_of_the_schedule():
    cfg, short = preset("default"), preset("default", iterations=500)
    assert (short.schedule.fine_iterations, short.schedule.half_resolution_iterations) == (500, 167)
    assert (short.density.start_iteration, short.temporal.start_iteration, short.density.stop_iteration) == (
        167,
        167,
        5556,
    )
    assert short.optim.decay_iterations == 500 and short.density.every == cfg.density.every
    assert cfg.replace({"iterations": "x2"}) == preset("default", iterations=2700)
    assert short.replace({"iterations": 1}).schedule.half_resolution_iterations == 1  # 0 would mean never
    assert preset("best", iterations=1500).optim.decay_iterations == 1500
    mine = cfg.replace({"optim.decay_iterations": 900, "iterations": 500})
    assert mine.optim.decay_iterations == 900  # what is named holds, in any order


@pytest.mark.parametrize("name", sorted({*preset_names()} - {"default", "best", "preview"}))
def test_a_published_schedule_changes_its_length_alone(name):
    cfg = preset(name)
    total = cfg.schedule.coarse_iterations + cfg.schedule.fine_iterations
    short = preset(name, iterations=30)
    assert cfg.schedule.literal and short.schedule.coarse_iterations + short.schedule.fine_iterations == 30
    assert short.schedule.coarse_iterations == round(30 * cfg.schedule.coarse_iterations / total)
    assert short.replace({"schedule.coarse_iterations": cfg.schedule.coarse_iterations,
                          "schedule.fine_iterations": cfg.schedule.fine_iterations}) == cfg  # fmt: skip


@pytest.mark.parametrize("wanted", [0, -3, 2.5, True, "many", None])
def test_a_length_that_is_none_is_rejected(wanted):
    with pytest.raises(InputError, match="iterations: expected a whole number above 0, got"):
        preset("default", iterations=wanted)


def test_a_field_goes_before_a_short_name_of_another():
    values = {"iterations": 1}
    config_io.override(values, {"iterations": 2}, "options of a plugin")
    assert values == {"iterations": 2}
    with pytest.raises(InputError, match=r"got gaussian\. Fix: See"):
        config_io.override(values, {"gaussian": 2}, "options of a plugin")


@pytest.mark.parametrize(
    ("changes", "says"),
    [
        ({"optim.mean_lr": 1.0}, r"got optim\.mean_lr\. Fix: Use `optim\.means_lr`\."),
        ({"budget": 3}, r"got budget\. Fix: Use `init\.budget`\."),
        ({"train.iterations": 3}, r"got train\.iterations\. Fix: Use `iterations`\."),
        ({"num_gaussians": 3}, r"got num_gaussians\. Fix: Use `gaussians`\."),
        ({"fine_iterations": 3}, r"got fine_iterations\. Fix: Use `schedule\.fine_iterations`\."),
        ({"init": 3}, "got init"),
        ({"zzz": 3}, r"got zzz\. Fix: See `endoprior train --help-all`\."),
        ({"init.budget": 0}, r"budget must be in \[1, 1e\+07\], got 0"),
        ({"init.budget": "many"}, r"config\.init\.budget: expected an integer"),
    ],
)
def test_wrong_replacements_are_named(changes, says):
    with pytest.raises(InputError, match=says):
        preset("default").replace(changes)


def leaves(values, prefix=""):
    for name, value in values.items():
        if isinstance(value, dict):
            yield from leaves(value, f"{prefix}{name}.")
        else:
            yield f"{prefix}{name}", value


@pytest.mark.parametrize("stored", [{"pose": {}}, {"loss": {"fit_depth": True}}, {"of_stored": []}])
def test_unknown_fields_of_a_stored_config_are_errors(stored):
    with pytest.raises(
        InputError, match=r"no such field\. Fix: Correct the name, or use the version of endoprior that"
    ):
        from_dict(Config, stored)
