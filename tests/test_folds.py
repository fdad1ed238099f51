"""Folds: which frame of every eight is held out, in a sequence, a run, an export and a benchmark."""

from __future__ import annotations

import hashlib
import json
from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest
import yaml
from benchmark_runs import in_this_process
from conftest import write_tiny_sequence
from plugin_packages import EXAMPLE, entry_points, on_path, write_package

from endoprior.cli import main
from endoprior.core.checks import InputError
from endoprior.core.config import DataConfig
from endoprior.core.config_io import to_dict
from endoprior.data import load_sequence
from endoprior.data.formats import REGISTRY
from endoprior.data.images import save_png
from endoprior.data.window_plan import summarize_frames
from endoprior.export.time_steps import frame_indices
from endoprior.runs.log import Growth
from endoprior_studies.matched_count import search_thresholds
from endoprior_studies.matrix import KEY_DIGITS, SCORES_VERSION, frames_of, run_matrix
from endoprior_studies.report import write_report
from endoprior_studies.results import Results
from endoprior_studies.spec import Cell, MatchSpec, MethodSpec, SequenceSpec, Spec, cells
from endoprior_studies.spec_file import load_spec

QUICK = "--iterations 6 --gaussians 200 --schedule.coarse-iterations 2 --no-networks".split()


def phases(path: Path, **fields) -> list[list[int]]:
    """Test frames of all phases."""
    return [load_sequence(path, DataConfig(test_phase=p, **fields)).indices("test") for p in range(8)]


def test_phases_share_out_all_frames(tiny_sequence):
    """17 frames: phase p has p + 1, p + 9, ...; phase 7 begins with frame 0. Together they hold every frame once."""
    found = phases(tiny_sequence)
    assert found[0] == [1, 9] == load_sequence(tiny_sequence).indices("test")
    assert found[3] == [4, 12] and found[6] == [7, 15] and found[7] == [0, 8, 16]
    assert sorted(i for frames in found for i in frames) == list(range(17))


def test_a_window_keeps_the_frames_that_are_held_out(tiny_sequence):
    whole, part = phases(tiny_sequence), phases(tiny_sequence, window="3-12")
    assert part == [[i - 3 for i in frames if 3 <= i <= 12] for frames in whole]


def test_training_reads_no_frame_of_its_fold(tiny_sequence):
    view = load_sequence(tiny_sequence, DataConfig(test_phase=3)).training_view()
    assert view.split_rule == "test iff (i - 1) % 8 == 3" and view.frame(1).index == 1
    for read in (lambda: view.frame(4), lambda: view.part(2, 9).frame(2), lambda: view.without_masks().frame(12)):
        with pytest.raises(ValueError, match="held out"):
            read()


def test_a_reader_of_another_package_cannot_differ(tiny_sequence, monkeypatch):
    """It gets the config and may ignore it, as readers did that were written before there were folds."""
    reader = REGISTRY.load("endonerf")
    old = SimpleNamespace(load=lambda path, cfg: reader.load(path, DataConfig()))
    monkeypatch.setattr(type(REGISTRY), "load", lambda self, name: old)
    assert load_sequence(tiny_sequence, DataConfig(format="endonerf", test_phase=7)).indices("test") == [0, 8, 16]


def test_a_phase_without_a_test_frame(make_tiny_sequence):
    path = make_tiny_sequence(num_frames=5, width=4, height=4)
    assert load_sequence(path, DataConfig(test_phase=3)).indices("test") == [4]
    assert load_sequence(path, DataConfig(test_phase=7)).indices("test") == [0]
    with pytest.raises(
        InputError, match=r"data\.test_phase: expected a phase that leaves a test frame of 5 frames, got 4"
    ):
        load_sequence(path, DataConfig(test_phase=4))


def test_windows_are_planned_without_the_first_frame_where_it_is_held_out(tiny_sequence):
    """It counts as the first training frame: a black picture would begin a new window at frame 1."""
    seen = summarize_frames(load_sequence(tiny_sequence, DataConfig(test_phase=7)).training_view())
    np.testing.assert_array_equal(seen.thumbnails[0], seen.thumbnails[1])
    assert seen.thumbnails[0].any() and seen.depth_mm[0] == seen.depth_mm[1]
    assert seen.depth_mm[8] == seen.depth_mm[7] and np.isfinite(seen.depth_mm).all()


@pytest.mark.parametrize("data", [DataConfig(), DataConfig(test_phase=7), DataConfig(test_phase=2, window="5-16")])
def test_exports_know_the_split_without_the_sequence(tiny_sequence, data):
    sequence = load_sequence(tiny_sequence, data)
    for split in ("test", "train", "video"):
        assert frame_indices(len(sequence), split, data) == sequence.indices(split)


@pytest.mark.slow
def test_a_run_keeps_its_fold_and_is_scored_on_it(tiny_sequence, tmp_path, capsys):
    """Phase 7, so that the first frame is held out, from which everything else would begin."""
    run = tmp_path / "run"
    assert main(["train", str(tiny_sequence), str(run), "--data.test-phase", "7", *QUICK]) == 0
    assert "test iff (i - 1) % 8 == 7" in capsys.readouterr().out
    trained = json.loads((run / "metrics.json").read_text())
    assert trained["protocol"]["frames"] == [0, 8, 16]
    assert trained["protocol"]["split_rule"] == "test iff (i - 1) % 8 == 7"
    assert trained["protocol"]["tags"]["split"] == "test 7/8, 3 frames"
    assert json.loads((run / "config.json").read_text())["config"]["data"]["test_phase"] == 7
    assert main(["eval", str(run), "--no-networks", "--out", str(tmp_path / "again")]) == 0
    again = json.loads((tmp_path / "again" / "metrics.json").read_text())
    assert again["protocol"]["frames"] == [0, 8, 16]
    assert again["scores"]["psnr_tissue"] == trained["scores"]["psnr_tissue"]


@pytest.mark.parametrize("phase", ["8", "-1", "2.5"])
def test_a_bad_phase_is_one_line(tiny_sequence, tmp_path, capsys, phase):
    assert main(["train", str(tiny_sequence), str(tmp_path / "run"), f"--data.test-phase={phase}"]) == 2
    said = capsys.readouterr().err
    assert "test" in said and "phase" in said and len(said.strip().splitlines()) == 1, said
    assert not (tmp_path / "run").exists()


SPEC = Spec(
    title="t",
    sequences={"s": SequenceSpec(path="s", folds=(0, 3)), "one": SequenceSpec(path="o")},
    methods={"a": MethodSpec(), "b": MethodSpec(preset="paper"), "theirs": MethodSpec(pictures={"s": "x"})},
    seeds=(0, 1),
    scores=("psnr",),
)


def test_every_cell_exists_once_per_fold():
    found = cells(SPEC)
    assert len(found) == len(set(found)) == 2 * (2 * 2 + 2) + 2
    assert Cell("s", "a", None, 1, 3) in found and Cell("one", "a", None, 1, 3) not in found
    assert [cell.fold for cell in found if cell.method == "theirs" and cell.sequence == "s"] == [0]
    assert Cell("s", "a", None, 1).name == "s/a/seed1" and Cell("s", "a", None, 1, 3).name == "s/a/seed1/fold3"
    assert SPEC.config("a", "s", None, 0, fold=3).data.test_phase == 3


def test_tables_are_of_the_mean_over_folds_and_differences_pair_folds():
    """By hand: a has (30, 34) and (31, 37) in the folds of the seeds, so 32 and 34; b is better by 1, 2, 3, 4."""
    psnr = {(0, 0): 30, (0, 3): 34, (1, 0): 31, (1, 3): 37}
    scores = {Cell("s", "a", None, seed, fold): {"psnr": value} for (seed, fold), value in psnr.items()}
    for add, ((seed, fold), value) in enumerate(psnr.items(), 1):
        scores[Cell("s", "b", None, seed, fold)] = {"psnr": value + add}
    results = Results(SPEC, scores)
    of_a = results.summary("s", None, "a", "psnr")
    assert (of_a.mean, of_a.count) == (33, 2) and of_a.std == pytest.approx(np.sqrt(2))
    assert [float((p.ours - p.theirs)[0]) for p in results.pairs("psnr", "b", "a", sequence="s")] == [1, 2, 3, 4]
    assert results.difference("psnr", "b", "a", "s").count == 4
    # A fold that has not run: its seed would be the mean of other frames.
    del scores[Cell("s", "a", None, 1, 3)]
    partial = Results(SPEC, scores)
    assert partial.summary("s", None, "a", "psnr").mean == 32
    assert partial.difference("psnr", "b", "a", "s").count == 3
    # A score that only some folds have, by all methods.
    scores |= {Cell("s", "a", None, 1, 3): {}}
    assert Results(SPEC, scores).summary("s", None, "a", "psnr").mean == (32 + 31) / 2


def test_images_of_one_training_are_compared_in_its_fold():
    scores = {Cell("s", "a", None, 0, fold): {"psnr": 30.0 + fold} for fold in (0, 3)}
    results = Results(replace(SPEC, seeds=(0,)), scores | {Cell("s", "theirs", None, 0): {"psnr": 29.0}})
    assert [float((p.ours - p.theirs)[0]) for p in results.pairs("psnr", "theirs", "a", sequence="s")] == [-1.0]


def test_own_and_found_parts_are_paired_though_folds_differ():
    found = SequenceSpec(path="s", masks="found", folds=(3, 5))
    spec = replace(SPEC, sequences={"s": SPEC.sequences["s"], "found": found})
    assert spec.with_own_parts("found") == "s" and spec.with_own_parts("s") is None
    scores = {Cell(name, "a", None, 0, f): {"psnr": 30.0 + f} for name in spec.sequences for f in (0, 3, 5)}
    assert Results(spec, scores).gain_of_found("psnr", "a", "found", "s").count == 1


@pytest.mark.parametrize("folds", [[], [0, 0], [8], [-1], [1.5], 3])
def test_wrong_folds_are_named(tmp_path, folds):
    values = {"title": "t", "sequences": {"s": {"path": "s", "folds": folds}}, "methods": {"a": {}}}
    (tmp_path / "spec.yaml").write_text(yaml.safe_dump(values))
    with pytest.raises(InputError, match=r"sequences\.s\.folds"):
        load_spec(tmp_path / "spec.yaml")


@pytest.mark.slow
def test_a_benchmark_of_folds(tmp_path):
    """A preset, a method of another package and images, each of the frames of its fold; cells of fold 0 stay."""
    data = write_tiny_sequence(tmp_path / "tiny")
    for fold in (0, 3):
        folder = tmp_path / "images" / str(fold)
        folder.mkdir(parents=True)
        for frame in load_sequence(data, DataConfig(test_phase=fold)).frames("test"):
            save_png(folder / f"{frame.index}.png", np.clip(frame.rgb_u8, 0, 250) + np.uint8(2 + fold))
    quick = {"schedule.fine_iterations": 4, "schedule.coarse_iterations": 0, "init.budget": 200}
    values = {
        "title": "Folds",
        "sequences": {"tiny": {"path": "tiny", "folds": [0, 3]}},
        "methods": {
            "ours": {"set": quick},
            "nearest": {"method": "nearest-frame"},
            "theirs": {"pictures": {"tiny": "images/{fold}"}},
        },
        "scores": ["psnr_tissue"],
        "figures": ["curves", "frames"],
    }
    (tmp_path / "spec.yaml").write_text(yaml.safe_dump(values, sort_keys=False))
    write_package(tmp_path / "site", "endoprior-example", entry_points(EXAMPLE))
    with on_path(EXAMPLE, tmp_path / "site"):
        spec = load_spec(tmp_path / "spec.yaml")
        done = run_matrix(spec, tmp_path / "out", in_this_process)
        write_report(done, tmp_path / "out")
        assert not done.missing and len({*done.done.values()}) == 6
        frames = {fold: [1 + fold, 9 + fold] for fold in (0, 3)}
        for cell, folder in done.done.items():
            stored = json.loads((folder / "metrics.json").read_text())
            assert stored["protocol"]["frames"] == frames[cell.fold], cell
            flow = frames_of(folder)["flow_error_dis"]  # between the two test frames, at the first of them
            assert flow == {frames[cell.fold][0]: stored["scores"]["flow_error_dis"]}
        names = {cell.method: folder.name for cell, folder in done.done.items() if not cell.fold}
        assert names["ours"] == former_name(spec, data, "ours")
        reading = spec.sequences["tiny"].reading
        assert names["nearest"] == former_name(
            spec, data, "nearest", "nearest-frame", "endoprior-example 1.0", 0, reading
        )
    text = (tmp_path / "out" / "results.md").read_text()
    assert "3 methods x 1 sequences, folds 0, 3 of tiny, seeds 0" in text
    assert "over seeds of the mean over folds (which frame of every eight is held out)" in text
    assert "[95 % interval over seeds and, where scores have values of frames, these]" in text
    assert "- `split_rule`: test iff (i - 1) % 8 == 0; test iff (i - 1) % 8 == 3" in text


def former_name(spec: Spec, data: Path, method: str, *more) -> str:
    """Folder of a cell by a version without folds: a hash of all options of that version, and more."""
    options = to_dict(spec.config(method, "tiny", None, 0))
    options.get("data", {}).pop("test_phase", None)
    options.pop("fit_to_clip", None)
    facts = [options, load_sequence(data).fingerprint(), False, SCORES_VERSION, *more]
    return hashlib.sha256(json.dumps(facts, sort_keys=True).encode()).hexdigest()[:KEY_DIGITS]


def test_a_threshold_is_searched_in_the_first_fold():
    sequences, trained = {"s": SequenceSpec(path="s", folds=(3, 5))}, []
    methods = {"grown": MethodSpec(preset="endogaussian", match=MatchSpec(growth=1.3))}

    def train(wanted):
        trained.extend(wanted)
        return dict.fromkeys(wanted, Growth(1000, 1300, 10, {}))

    found = search_thresholds(replace(SPEC, sequences=sequences, methods=methods), lambda place: 0.0, train)
    assert trained == [Cell("s", "grown", None, 0, 3)] and found["s", "grown", None].matched
