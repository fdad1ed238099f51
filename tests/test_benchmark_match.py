"""Counts that are matched: the search on known curves, what a spec may say, and cells that run with what it finds."""

import math
from shutil import rmtree

import numpy as np
import pytest
import yaml
from benchmark_runs import in_this_process

from endoprior.core.checks import InputError
from endoprior.runs.log import Growth
from endoprior_studies.matched_count import MAX_PROBES, Search, next_threshold, search_thresholds
from endoprior_studies.matrix import run_matrix
from endoprior_studies.report import write_report
from endoprior_studies.spec import Cell, MatchSpec, MethodSpec, SequenceSpec, Spec
from endoprior_studies.spec_file import load_spec
from endoprior_studies.tables import matched_table


def grown(last: float, first: int = 1000) -> Growth:
    return Growth(first, round(last), 10, {})


def tried_until_done(search: Search, curve) -> Search:
    while (value := next_threshold(search)) is not None:
        search.tried.append((value, grown(curve(value))))
    return search


@pytest.mark.parametrize("slope", [0.3, 0.7, 1.5])
@pytest.mark.parametrize("target", [2000, 20_000, 60_000])
def test_a_power_law_is_matched_in_a_few_trainings(slope, target):
    search = tried_until_done(Search(2e-4, target=target), lambda value: 20_000 * (value / 2e-4) ** -slope)
    assert search.matched and len(search.tried) <= 6


def test_the_next_threshold_lies_inside_of_the_narrowest_bracket():
    counts = {1e-4: 4000, 2e-4: 2000, 8e-4: 500, 4e-4: 900}
    search = Search(1e-4, [(value, grown(last)) for value, last in counts.items()], target=1000)
    assert next_threshold(search) == pytest.approx(2e-4 * 2 ** (np.log(2) / np.log(2000 / 900)), rel=1e-6)


def test_a_curve_with_a_floor_ends_without_success():
    search = tried_until_done(Search(2e-4, target=500), lambda value: 5000 + 1e-3 / value)
    assert len(search.tried) == MAX_PROBES and not search.matched
    assert search.best[1].last == min(growth.last for _, growth in search.tried)


def test_counts_that_rise_with_the_threshold_end_the_search():
    search = tried_until_done(Search(2e-4, target=1000), lambda value: 800 if value < 3e-4 else 1200)
    assert len(search.tried) <= MAX_PROBES and not search.matched


def spec_of(**methods: MatchSpec | None) -> Spec:
    made = {name: MethodSpec(preset="endogaussian", match=match) for name, match in methods.items()}
    return Spec("t", {"clip": SequenceSpec(path="x")}, made, seeds=(3, 4))


def test_a_count_a_growth_and_a_value_are_found():
    matches = {"many": MatchSpec(count_of="base"), "grown": MatchSpec(growth=1.3), "same": MatchSpec(value_of="grown")}
    spec, trained = spec_of(base=None, **matches), []

    def train(cells):
        trained.append(cells)
        return {cell: grown(2000 * (value / 2e-4) ** -0.7) for cell, value in cells.items()}

    found = search_thresholds(spec, {("clip", "base", None): 4000.0}.__getitem__, train)
    assert trained[0] == {Cell("clip", name, None, 3): 2e-4 for name in ("many", "grown")}, "side by side"
    assert found["clip", "many", None].best[0] == pytest.approx(2e-4 * 2 ** (-1 / 0.7), rel=0.05)
    assert found["clip", "grown", None].best[0] == pytest.approx(2e-4 * (1.3 / 2) ** (-1 / 0.7), rel=0.05)
    assert found["clip", "same", None] is found["clip", "grown", None]
    table = matched_table(spec, found).splitlines()
    assert "4,000: as base" in table[2] and "1,300: 1.3 times the start" in table[3]
    assert "| - | threshold of grown |" in table[4]


def test_what_fails_has_a_reason():
    spec = spec_of(base=None, many=MatchSpec(count_of="base"), grown=MatchSpec(growth=2.0))
    found = search_thresholds(spec, lambda place: math.nan, lambda cells: dict.fromkeys(cells, "it broke"))
    assert found["clip", "many", None].failure == "base has no result to match"
    assert found["clip", "grown", None].failure == "it broke"
    assert "none: it broke" in matched_table(spec, found).splitlines()[3]


PRESET = {"preset": "endogaussian"}


@pytest.mark.parametrize(
    ("match", "said"),
    [
        ({}, "methods.b.match: expected one of count_of, growth and value_of"),
        ({"count_of": "a", "growth": 2}, "none or several"),
        ({"count_of": "nobody"}, "methods.b.match.count_of: expected one of a"),
        ({"count_of": "b"}, "methods.b.match.count_of: expected one of a"),
        ({"value_of": "a"}, "methods.b.match.value_of: expected one of c"),
        ({"growth": -1}, "methods.b.match.growth: expected a number above 0"),
        ({"factor": 1}, "factor"),
    ],
)
def test_bad_matches_are_named(tmp_path, match, said):
    methods = {"a": PRESET, "b": PRESET | {"match": match}, "c": PRESET | {"match": {"growth": 2}}}
    file = tmp_path / "spec.yaml"
    file.write_text(yaml.safe_dump({"title": "t", "sequences": {"p": {"phantom": {}}}, "methods": methods}))
    with pytest.raises(InputError) as error:
        load_spec(file)
    assert said in str(error.value)


@pytest.mark.slow
def test_a_benchmark_trains_with_what_it_finds(tmp_path):
    events = {"density.start_iteration": 2, "density.every": 2}
    planes = {"deformation.hexplane.channels": 8, "deformation.hexplane.multires": [1]}
    values = {
        "title": "t",
        "sequences": {"p": {"phantom": {"frames": 9, "width": 64, "height": 64}}},
        "methods": {
            "base": PRESET | {"set": {"density.grow_threshold": 1e-3}},
            "many": PRESET | {"set": {"density.grow_threshold": 1e-9}, "match": {"count_of": "base"}},
        },
        "seeds": [0, 1],
        "set": {"init.budget": 200, "schedule.coarse_iterations": 4, "schedule.fine_iterations": 8, **events, **planes},
        "scores": ["num_gaussians", "gaussians_growth"],
        "figures": [],
    }
    file = tmp_path / "spec.yaml"
    file.write_text(yaml.safe_dump(values))
    spec, said = load_spec(file), []
    assert not run_matrix(spec, tmp_path / "out", None).done, "without an executor nothing runs"
    matrix = run_matrix(spec, tmp_path / "out", in_this_process, progress=said.append)
    assert not matrix.missing and len(matrix.done) == 4 and "2 after a search" in said[0]
    search = matrix.searches["p", "many", None]
    assert search.tried[0][0] == 1e-9 and len(search.tried) > 1, "the first threshold lets far more grow"
    assert "## Thresholds found" in write_report(matrix, tmp_path / "out").read_text()
    again = run_matrix(spec, tmp_path / "out", None)
    assert again.done == matrix.done and again.searches == matrix.searches, "it finds the same, training nothing"
    rmtree(matrix.done[Cell("p", "many", None, 0)])
    left = run_matrix(spec, tmp_path / "out", None)
    assert {cell.method for cell in left.done} == {"base"}, "a probe is not the method that was asked for"
    assert {cell.name for cell in left.missing} == {Cell("p", "many", None, seed).name for seed in (0, 1)}
