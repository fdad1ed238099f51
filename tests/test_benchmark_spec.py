"""Specs: what a file says, every mistake named, and the cells that come of it."""

from __future__ import annotations

from pathlib import Path

import pytest
import yaml

from endoprior.benchmark.spec import Cell, cells, load_spec, sequence_folder
from endoprior.checks import InputError

SPECS = Path(__file__).parents[1] / "bench" / "specs"
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
        ({"colour": "red"}, "spec.colour: no such field"),
        ({"seeds": [1, 1]}, "seeds: expected different numbers"),
        ({"seeds": []}, "seeds: expected different numbers"),
        ({"seeds": ["a"]}, r"spec.seeds\[0\]: expected int"),
        ({"sequences": {"a/b": {"path": "x"}}}, "sequences: expected a name"),
        ({"sequences": {"a": {}}}, "sequences.a: expected either path or phantom"),
        ({"sequences": {"a": {"phantom": {"frames": 1}}}}, "frames"),
        ({"sequences": {"a": {"phantom": {}, "shrink": 2}}}, "a phantom is written at its size"),
        ({"methods": {"m": {"preset": "best"}}}, "methods.m.preset: expected one of default"),
        ({"methods": {"m": {"set": {"init": 3}}}}, "methods.m.set: expected the dotted name"),
        ({"methods": {"m": {"set": {"init.bugdet": 3}}}}, "methods.m.set: expected the dotted name"),
        ({"methods": {"m": {"set": {"init.erosion_px": "big"}}}}, "methods.m.init.erosion_px: expected int"),
        ({"set": {"density.min_densify_weight": 3.0}}, "min_densify_weight must be in"),
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
    with pytest.raises(InputError, match="--data x: no such sequence"):
        load_spec(written(tmp_path), {"x": tmp_path})


@pytest.mark.parametrize("path", sorted(SPECS.glob("*")), ids=lambda p: p.name)
def test_ready_specs_can_be_read(path):
    spec = load_spec(path)
    assert cells(spec) and spec.about
