"""Specs: what a file says, every mistake named, and the cells that come of it."""

from __future__ import annotations

import re
from dataclasses import replace
from pathlib import Path

import pytest
import yaml

from endoprior.cli import main
from endoprior.core.checks import InputError
from endoprior.data.scared import STRIDES, dataset_number
from endoprior.model.presets import preset
from endoprior_studies.spec import Cell, MethodSpec, cells, sequence_folder
from endoprior_studies.spec_file import find_spec, load_spec, load_specs, spec_names, specs_of

PLAIN = {
    "title": "two methods",
    "sequences": {"clip": {"path": "clips/a", "shrink": 2}, "ph": {"phantom": {"frames": 9}}},
    "methods": {
        "base": {"preset": "endogaussian", "set": {"temporal.weight": 0.5}},
        "ours": {"label": "Ours", "set": {"schedule.fine_iterations": 7, "deformation.basis.num_bases": 5}},
    },
    "budgets": [100, 200],
    "seeds": [3, 1],
    "set": {"schedule.fine_iterations": 9, "temporal.weight": 0.25},
}


def written(folder: Path, **changes) -> Path:
    """A spec file with some entries changed; None removes one."""
    values = {key: value for key, value in (PLAIN | changes).items() if value is not None}
    path = folder / "spec.yaml"
    path.write_text(yaml.safe_dump(values))
    return path


def test_cells_are_the_product_with_whole_seeds_first(tmp_path):
    found = cells(load_spec(written(tmp_path)))
    assert len(found) == 16 and found[0] == Cell("clip", "base", 100, 3)
    assert [cell.seed for cell in found] == [3] * 8 + [1] * 8
    assert found[0].name == "clip/base@100/seed3" and len({cell.name for cell in found}) == 16
    assert Cell("clip", "base", None, 3).name == "clip/base/seed3"


def test_configs_take_presets_then_common_then_own_settings(tmp_path):
    spec = load_spec(written(tmp_path))
    base, ours = spec.config("base", "clip", 100, 3), spec.config("ours", "ph", 200, 1)
    assert (base.temporal.weight, base.schedule.fine_iterations, base.init.budget, base.seed) == (0.5, 9, 100, 3)
    assert (ours.temporal.weight, ours.schedule.fine_iterations, ours.init.budget, ours.seed) == (0.25, 7, 200, 1)
    assert base.init.sampler == "pool" and ours.deformation.basis.num_bases == 5
    assert (base.data.shrink, ours.data.shrink) == (2, 1)
    assert spec.reference == "base" and spec.label("ours") == "Ours" and spec.label("base") == "base"


def test_settings_by_preset_and_factors(tmp_path):
    changes = {"set_for": {"default": {"schedule.fine_iterations": 20, "temporal.weight": "x2"}}}
    methods = {"m": {"set": {"schedule.fine_iterations": "x0.75"}}, "e": {"preset": "endogaussian"}}
    spec = load_spec(written(tmp_path, methods=methods, **changes))
    ours, theirs = spec.config("m", "ph", 100, 0), spec.config("e", "ph", 100, 0)
    assert (ours.schedule.fine_iterations, ours.temporal.weight) == (15, 0.5)
    assert (theirs.schedule.fine_iterations, theirs.temporal.weight) == (9, 0.25)


def test_a_claim_with_lists_is_one_for_each_score_and_method(tmp_path):
    claims = [
        {"score": ["psnr", "ssim"], "method": "ours", "than": ["base", "ours"], "by": 0.5},
        {"score": "psnr", "method": "base", "than": "ours"},
    ]
    found = [(c.score, c.method, c.than, c.by) for c in load_spec(written(tmp_path, claims=claims)).claims]
    assert found[:3] == [("psnr", "ours", "base", 0.5), ("psnr", "ours", "ours", 0.5), ("ssim", "ours", "base", 0.5)]
    assert found[3:] == [("ssim", "ours", "ours", 0.5), ("psnr", "base", "ours", 0.0)]


def test_a_file_extends_others(tmp_path):
    written(tmp_path)
    small = {"seeds": [5], "set": {"temporal.weight": 0.125}, "sequences": {"only": {"path": "here"}}}
    (tmp_path / "small.yaml").write_text(yaml.safe_dump(small))
    top = {"extends": ["spec.yaml", "small.yaml"], "title": "top", "set": {"init.opacity": 0.5}}
    (tmp_path / "top.yaml").write_text(yaml.safe_dump(top))
    spec = load_spec(tmp_path / "top.yaml")
    assert (spec.title, spec.seeds, list(spec.sequences), spec.budgets) == ("top", (5,), ["only"], (100, 200))
    assert spec.set == {"schedule.fine_iterations": 9, "temporal.weight": 0.125, "init.opacity": 0.5}
    (tmp_path / "small.yaml").write_text("extends: [top.yaml]")
    with pytest.raises(InputError, match="does not extend itself"):
        load_spec(tmp_path / "top.yaml")


def test_places_of_sequences(tmp_path, monkeypatch):
    spec = load_spec(written(tmp_path))
    assert sequence_folder(spec, "clip", tmp_path / "out") == tmp_path / "clips/a"
    phantom = sequence_folder(spec, "ph", tmp_path / "out")
    assert phantom.parent == tmp_path / "out" / "sequences"
    other = load_spec(written(tmp_path, sequences={"ph": {"phantom": {"frames": 10}}}))
    assert sequence_folder(other, "ph", tmp_path / "out") != phantom
    monkeypatch.setenv("CLIPS", "/somewhere")
    moved = load_spec(written(tmp_path, sequences={"clip": {"path": "$CLIPS/b"}}))
    assert sequence_folder(moved, "clip", tmp_path) == Path("/somewhere/b")
    replaced = load_spec(written(tmp_path), {"clip": tmp_path / "mine"})
    assert sequence_folder(replaced, "clip", tmp_path) == tmp_path / "mine"


def test_a_sequence_with_found_parts_knows_the_one_with_its_own(tmp_path):
    ph, clip = {"phantom": {"frames": 9}}, {"path": "clips/a", "shrink": 2}
    found = {"found": clip | {"masks": "found"}, "ph_found": ph | {"masks": "found"}, "other": {"path": "b"}}
    found |= {"posed": clip | {"poses": "estimated"}, "both": clip | {"masks": "found", "poses": "estimated"}}
    spec = load_spec(written(tmp_path, sequences={"clip": clip, "ph": ph} | found))
    own = {name: spec.with_own_parts(name) for name in spec.sequences}
    assert own == {
        "clip": None,
        "ph": None,
        "found": "clip",
        "ph_found": "ph",
        "other": None,
        "posed": "clip",
        "both": "clip",
    }
    parts = {"posed": {"poses": "estimated"}, "both": {"masks": "found", "poses": "estimated"}, "clip": {}}
    assert all(spec.sequences[name].found_parts == found for name, found in parts.items())
    assert sequence_folder(spec, "ph", tmp_path) == sequence_folder(spec, "ph_found", tmp_path)
    alone = load_spec(written(tmp_path, sequences={"found": found["found"], "larger": clip | {"shrink": 1}}))
    assert alone.with_own_parts("found") is None


def test_toml_says_the_same(tmp_path):
    path = tmp_path / "spec.toml"
    path.write_text('title = "t"\nseeds = [4]\n[sequences.s]\npath = "x"\n[methods.m.set]\n"temporal.weight" = 0\n')
    spec = load_spec(path)
    assert spec.seeds == (4,) and spec.config("m", "s", None, 4).temporal.weight == 0


@pytest.mark.parametrize(
    ("changes", "named"),
    [
        ({"title": None}, "title: expected an entry"),
        ({"methods": {}}, "methods: expected an entry"),
        ({"colour": "red"}, "no such field"),
        ({"seeds": [1, 1]}, "seeds: expected different numbers"),
        ({"seeds": []}, "seeds: expected different numbers"),
        ({"seeds": ["a"]}, r"spec.seeds\[0\]: expected an integer"),
        ({"sequences": {"a/b": {"path": "x"}}}, "sequences: expected a name"),
        ({"sequences": {"a": {}}}, "sequences.a: expected either path or phantom"),
        ({"sequences": {"a": {"phantom": {"frames": 1}}}}, "frames"),
        ({"sequences": {"a": {"phantom": {}, "shrink": 2}}}, "a phantom has its own size"),
        ({"sequences": {"a": {"path": "x", "format": "endo"}}}, "sequences.a.format: expected auto, scared"),
        ({"sequences": {"a": {"path": "x", "masks": "hidden"}}}, "sequences.a.masks: expected one of 'given', 'found'"),
        (
            {"sequences": {"a": {"path": "x", "masks": "found"}}, "set": {"data.use_gt_masks": True}},
            "sequences.a.masks: expected either found or gt_masks, got both",
        ),
        ({"sequences": {"a": {"path": "x", "poses": "own"}}}, "a.poses: expected one of 'given', 'estimated'"),
        (
            {"sequences": {"a": {"path": "x", "poses": "estimated"}}, "set": {"data.depth_unit_mm": 0.5}},
            "sequences.a.poses: expected either estimated or data.depth_unit_mm, got both",
        ),
        ({"methods": {"m": {"preset": "finest"}}}, "methods.m.preset: expected one of default"),
        ({"methods": {"m": {"set": {"init": 3}}}}, "methods.m.set: expected the name of a config field"),
        ({"methods": {"m": {"set": {"init.bugdet": 3}}}}, "methods.m.set: expected the name of a config field"),
        ({"methods": {"m": {"set": {"density.every": "big"}}}}, "methods.m.density.every: expected an integer"),
        ({"set_for": {"finest": {}}}, "set_for: expected one of default"),
        ({"extends": "spec.yaml"}, "`extends` a list of files"),
        ({"set": {"density.min_densify_weight": 3.0}}, "min_densify_weight must be in"),
        ({"scores": ["psnr", "speed"]}, "names of scores, got 'speed'"),
        ({"claims": [{"score": "speed", "method": "ours", "than": "base"}]}, "names of scores, got 'speed'"),
        ({"claims": [{"score": [], "method": "ours", "than": "base"}]}, "claims.0.score: expected a name or a list of"),
        ({"claims": {"score": "psnr"}}, "claims: expected a list"),
        ({"claims": [{"score": "psnr", "method": "ours"}]}, "than: expected an entry, got none"),
        ({"compare_with": "them"}, "compare_with: expected one of base, ours"),
        ({"claims": [{"score": "psnr", "method": "ours", "than": "nobody"}]}, "expected one of base, ours"),
        ({"claims": [{"score": "psnr", "method": "ours", "than": "base", "expect": "magic"}]}, "expect: expected one"),
    ],
)
def test_mistakes_are_named(tmp_path, changes, named):
    with pytest.raises(InputError, match=named) as caught:
        load_spec(written(tmp_path, **changes))
    assert str(caught.value).startswith(str(tmp_path / "spec.yaml"))


def test_unreadable_files_are_named(tmp_path):
    (tmp_path / "a.yaml").write_text("title: [")
    (tmp_path / "a.txt").write_text("title: a")
    for name, said in (("a.yaml", "expected valid yaml"), ("a.txt", "expected a .yaml"), ("b.yaml", "readable file")):
        with pytest.raises(InputError, match=said):
            load_spec(tmp_path / name)
    with pytest.raises(InputError, match="--data x: expected one of clip, ph"):
        load_spec(written(tmp_path), {"x": tmp_path})


def test_a_folder_of_specs_takes_folders_of_the_sequences_of_any(tmp_path):
    paths = [written(tmp_path), tmp_path / "other.yaml"]
    written(tmp_path, sequences={"ph": {"phantom": {"frames": 10}}}).rename(paths[1])
    written(tmp_path)
    first, second = load_specs(paths, {"clip": tmp_path / "mine"}).values()
    assert first.sequences["clip"].path == str(tmp_path / "mine") and {*second.sequences} == {"ph"}
    with pytest.raises(InputError, match="--data x: expected one of clip, ph"):
        load_specs(paths, {"x": tmp_path})


@pytest.mark.parametrize("name", spec_names())
def test_ready_specs_are_read_by_name(name):
    if (found := find_spec(name)).is_dir():
        assert {*specs_of(found)} <= {find_spec(each) for each in spec_names()}, "each is read by its own name"
    else:
        spec = load_spec(found)
        assert cells(spec) and spec.about


@pytest.mark.parametrize("size", ["full", "sized"])
def test_the_ladder_leads_from_endogaussian_to_released(size):
    spec = load_spec(find_spec(f"{size}/ladder"))
    for sequence in spec.sequences:
        for step, name in (("base", "endogaussian"), ("temporal", "released")):
            want = replace(spec, methods={step: MethodSpec(preset=name)}).config(step, sequence, None, 0)
            assert spec.config(step, sequence, None, 0) == want


FULL = ("full/compared", "whole/clip", "whole/phantom")


@pytest.mark.parametrize("name", [*FULL, "sized/compared", "whole/kinds", "whole/own"])
def test_each_compared_method_is_there_as_released_and_fitted_to_the_clip(name):
    spec = load_spec(find_spec(name))
    fitted = [method for method in spec.methods if method.endswith("_fitted")]
    assert {*spec.methods} == {*fitted, *(one.removesuffix("_fitted") for one in fitted)} | {"default"} | (
        {"best", "without_flow"} & {*spec.methods}
    )
    (sequence,) = [*spec.sequences][:1]
    for method in fitted:
        found = spec.config(method, sequence, None, 0)
        assert found.fit_to_clip
        assert found.replace({"fit_to_clip": False}) == spec.config(method.removesuffix("_fitted"), sequence, None, 0)
    start = {method: spec.config(method, sequence, None, 0).init.budget for method in ("endogaussian", "default")}
    assert start["endogaussian"] == start["default"] == (30_000 if name in FULL else 7500)
    equal = load_spec(find_spec(name.split("/")[0].replace("whole", "full") + "/matched"))
    on = next(iter(equal.sequences))
    starts = [equal.config(method, on, None, 0).init.budget for method in ("endogaussian", "paper")]
    assert starts[0] == starts[1], "claims of the paper are judged at an equal start"


def test_scared_has_the_settings_published_for_it():
    """EndoGaussian's and the released code's; the paper says nothing but EndoGaussian's schedule."""
    spec, methods = load_spec(find_spec("reproduce/table1_scared")), load_spec(find_spec("reproduce/table1"))
    assert {*methods.sequences} == {"pulling", "cutting"} and spec.methods == methods.methods
    strides = {dataset_number(spec.resolved(about.path)): about.stride for about in spec.sequences.values()}
    assert strides == STRIDES, "whatever the user's folder is called"
    published = {"deformation.hexplane.channels": 32, "deformation.deform_shape": False}
    shorter = published | {"schedule.fine_iterations": 2000, "optim.decay_iterations": 2000}
    # The release trains as long as on EndoNeRF, does not clean up, and its pixels and principal point agree.
    released = published | {"released.cleanup": False, "released.half_pixel_shift": False}
    many = {"init.budget": 30_000}
    for method, changes in (
        ("endogaussian", shorter | many),
        ("paper", shorter),
        ("released", released),
        ("default", {}),
    ):
        found = spec.config(method, "d1", None, 0)
        assert found == replace(preset(method).replace(changes), data=found.data)
        assert found.data.lift_missing_depth == preset(method).data.lift_missing_depth


@pytest.mark.parametrize("size", ["full", "sized"])
def test_depth_flags_change_the_flags_and_nothing_else(size):
    spec = load_spec(find_spec(f"{size}/depth_flags"))
    flags = {"kept": (False, True), "centers": (True, False), "both": (False, False)}
    for base, changes in (("endogaussian", flags), ("paper", {"paper_flags": (True, True)})):
        for method, (lifted, offset) in changes.items():
            for sequence in spec.sequences:
                want = spec.config(base, sequence, None, 0).replace(
                    {"data.lift_missing_depth": lifted, "released.half_pixel_shift": offset}
                )
                assert spec.config(method, sequence, None, 0) == want != spec.config(base, sequence, None, 0)


def test_names_are_listed_and_win_over_paths(tmp_path, monkeypatch, capsys):
    names = spec_names()
    assert {"quick", "found_masks", "poses", "sized", "whole/clip", "full", "reproduce", "reproduce/table1"} <= {*names}
    assert not [name for name in names if "_small" in name], "it is only there to be extended"
    monkeypatch.chdir(tmp_path)
    written(tmp_path).rename("quick")
    assert find_spec("quick").is_absolute() and find_spec("./quick") == Path("quick")
    with pytest.raises(SystemExit):
        main(["bench", "--help"])
    words = {*re.findall(r"\w+", capsys.readouterr().out)}
    assert {part for name in names for part in name.split("/")} <= words


@pytest.mark.parametrize("spec", ["quik", "nowhere/spec.yaml"])
def test_neither_a_name_nor_a_path_is_one_line_with_the_names(tmp_path, capsys, spec):
    assert main(["bench", spec, str(tmp_path / "out")]) == 2
    text = capsys.readouterr().err
    assert (
        text.startswith(f"endoprior: {spec}: expected a file, a folder or one of found_masks, full,")
        and "quick" in text
    )
    assert text.count("\n") == 1 and not (tmp_path / "out").exists()
