"""Sequences with `masks: found`: what is trained on, what scores are taken against, what is kept, what is an error."""

from __future__ import annotations

import json
import shutil
from pathlib import Path

import numpy as np
import pytest
import yaml
from benchmark_runs import contents, in_this_process
from conftest import write_tiny_sequence

from endoprior.cli import main
from endoprior.core.config import DataConfig
from endoprior.data import load_sequence
from endoprior.evaluation.scoring import evaluate, scored_data
from endoprior.evaluation.true_masks import SCORES, TrueMasks, score_masks
from endoprior.model.scene_file import load_scene
from endoprior.tool_masks import FoundTools
from endoprior_studies import changed_copy
from endoprior_studies.changed_copy import write_copy
from endoprior_studies.matrix import Matrix, run_matrix, scores_of
from endoprior_studies.method import PresetMethod
from endoprior_studies.report import write_report
from endoprior_studies.results import Results
from endoprior_studies.spec import Cell, SequenceSpec
from endoprior_studies.spec_file import load_spec

OWN, FOUND = Cell("tiny", "m", None, 0), Cell("tiny_found", "m", None, 0)
QUICK = {"schedule.fine_iterations": 6, "schedule.coarse_iterations": 0, "init.budget": 200, "init.motion": "rest"}


def write_spec(folder: Path, **changes) -> Path:
    """The tiny sequence with its own and with found masks, one method, one seed."""
    values = {
        "title": "Tiny",
        "sequences": {"tiny": {"path": "tiny"}, "tiny_found": {"path": "tiny", "masks": "found"}},
        "methods": {"m": {}},
        "set": QUICK,
        "scores": ["psnr_tissue", "mask_iou", "false_area", "boundary_f1", "missed_tips"],
        "figures": [],
    } | changes
    path = folder / "spec.yaml"
    path.write_text(yaml.safe_dump(values))
    return path


def masks_of(folder: Path) -> list[np.ndarray]:
    return [~frame.tissue_mask for frame in load_sequence(folder, DataConfig()).frames("video")]


@pytest.fixture(scope="module")
def finished(tmp_path_factory):
    """The finished matrix, the masks that training got by sequence folder, and the sequence before and after."""
    folder = tmp_path_factory.mktemp("masks")
    data = write_tiny_sequence(folder / "tiny")
    before, trained, said = contents(data), {}, []

    def spy(method, sequence, options, **others):
        trained[sequence.path] = [~sequence.frame(i).tissue_mask for i in sequence.indices("train")]
        return train(method, sequence, options, **others)

    train = PresetMethod.train
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(PresetMethod, "train", spy)
        matrix = run_matrix(load_spec(write_spec(folder)), folder / "out", in_this_process, progress=said.append)
    assert not matrix.missing and "tiny_found: finding tools in 17 frames" in said
    return matrix, trained, (before, contents(data))


def copy_of(matrix: Matrix) -> Path:
    """The copy of the sequence that has found masks."""
    (copy,) = (matrix.out / "sequences").iterdir()
    return copy


def test_training_gets_the_found_masks_and_the_sequence_is_only_read(finished):
    matrix, trained, (before, after) = finished
    own, copy = matrix.data["tiny_found"], copy_of(matrix)
    assert before == after and trained.keys() == {own, copy}
    assert not (copy / "masks_before").exists(), "the hidden masks are nowhere in the copy"
    files = {file.relative_to(copy).as_posix() for file in copy.rglob("*") if file.is_file()}
    scores = {"mask_scores.json", "mask_scores_per_frame.json"}
    assert files - scores == {file.relative_to(own).as_posix() for file in own.rglob("*") if file.is_file()}
    train = load_sequence(own, DataConfig()).indices("train")
    for folder in (own, copy):
        expected = [masks_of(folder)[i] for i in train]
        assert all((a == b).all() for a, b in zip(trained[folder], expected, strict=True))
    assert any((a != b).any() for a, b in zip(trained[own], trained[copy], strict=True))


def test_scores_are_taken_against_the_own_masks(finished):
    matrix, _, _ = finished
    scene = load_scene(matrix.done[FOUND] / "run")
    truth = load_sequence(matrix.data["tiny_found"], scored_data(scene.config.data))
    found = scores_of(matrix.done[FOUND])
    assert found["protocol"]["data_fingerprint"] == truth.fingerprint()
    assert found["scores"]["psnr_tissue"] == evaluate(scene, truth).scores["psnr_tissue"]
    assert "masks: found" in found["protocol"] and "masks: found" not in scores_of(matrix.done[OWN])["protocol"]


def test_results_have_the_scores_of_the_masks_for_found_ones_only(finished):
    matrix, _, _ = finished
    copy = load_sequence(copy_of(matrix), DataConfig())
    expected = score_masks(copy, TrueMasks(matrix.data["tiny"], copy))
    found, own = scores_of(matrix.done[FOUND]), scores_of(matrix.done[OWN])
    names = {score.name for score in SCORES}
    assert (
        names <= found["scores"].keys() | found["skipped"].keys() and expected.scores.items() <= found["scores"].items()
    )
    assert expected.skipped.items() <= found["skipped"].items()
    assert not names & (own["scores"].keys() | own["skipped"].keys())


def test_the_report_shows_what_found_masks_cost(finished):
    matrix, _, _ = finished
    text = write_report(matrix, matrix.out).read_text()
    _, own, found = text.split("\n## ")[:3]
    assert own.startswith("tiny\n") and "Paired" not in own
    assert "| method | tissue PSNR, dB | training PSNR, dB |\n" in own
    assert "| method | tissue PSNR, dB | training PSNR, dB | IoU | false area |" in found
    values = [scores_of(matrix.done[cell])["scores"]["psnr_tissue"] for cell in (OWN, FOUND)]
    cost = f"{values[1] - values[0]:+.2f} dB"
    assert "Paired difference to tiny, which has its own masks, positive where better" in found
    assert found.count("| method | tissue PSNR, dB |\n") == 1 and f"| m | {cost} |" in found
    (gain,) = json.loads((matrix.out / "results.json").read_text())["gains_of_found_parts"]
    assert (gain["sequence"], gain["than"], gain["score"]) == ("tiny_found", "tiny", "psnr_tissue")
    assert gain["mean"] == pytest.approx(values[1] - values[0]) and gain["pairs"] == 1
    assert np.isnan(Results.of(matrix).value(OWN, "mask_iou"))


def test_scores_of_masks_have_no_spread_over_seeds(tmp_path):
    spec = load_spec(write_spec(tmp_path, seeds=[0, 1, 2]))
    cells = {Cell("tiny_found", "m", None, seed): {"mask_iou": 0.75, "psnr_tissue": 30.0 + seed} for seed in (1, 2)}
    results = Results(spec, cells)
    of_masks = results.summary("tiny_found", None, "m", "mask_iou")
    assert (of_masks.mean, of_masks.count) == (0.75, 1) and np.isnan(of_masks.std)
    assert results.summary("tiny_found", None, "m", "psnr_tissue").count == 2
    assert not results.summary("tiny", None, "m", "mask_iou").count


def test_found_masks_are_found_once_and_again_for_other_files(finished, tmp_path, monkeypatch):
    matrix, _, _ = finished
    for name in ("tiny", "out", "spec.yaml"):
        source = matrix.out.parent / name
        (shutil.copytree if source.is_dir() else shutil.copyfile)(source, tmp_path / name)
    calls = []
    monkeypatch.setattr(changed_copy, "find_in_sequence", lambda sequence: calls.append(1) or iter(masks()))

    def masks():
        return [(np.zeros((40, 48), bool), FoundTools(np.zeros((40, 48), bool), 1.0))] * 17

    spec, before = load_spec(tmp_path / "spec.yaml"), contents(tmp_path / "out")
    again = run_matrix(spec, tmp_path / "out", in_this_process)
    assert not calls and len(again.done) == 2 and contents(tmp_path / "out") == before
    (tmp_path / "tiny" / "masks" / "000003.png").write_bytes((tmp_path / "tiny/masks/000012.png").read_bytes())
    assert not run_matrix(spec, tmp_path / "out", None).done, "both have another truth"
    assert not calls, "a report finds nothing"
    jobs = []
    run_matrix(spec, tmp_path / "out", lambda found: iter(jobs.extend(found) or []))
    assert calls == [1] and len(jobs) == 2 and len([*(tmp_path / "out" / "sequences").iterdir()]) == 2


def test_the_masks_are_hidden_from_the_finder_and_an_interruption_leaves_nothing(tmp_path, monkeypatch):
    sequence = load_sequence(write_tiny_sequence(tmp_path / "tiny"), DataConfig())

    def interrupted(hidden):
        assert all(frame.tissue_mask.all() for frame in hidden.frames("video"))
        yield np.zeros((40, 48), bool), FoundTools(np.zeros((40, 48), bool), 1.0)
        raise KeyboardInterrupt

    monkeypatch.setattr(changed_copy, "find_in_sequence", interrupted)
    with pytest.raises(KeyboardInterrupt):
        write_copy(sequence, tmp_path / "found" / "copy", SequenceSpec(masks="found"))
    assert not [*(tmp_path / "found").iterdir()]
    assert not sequence.frame(0).tissue_mask.all(), "the sequence itself keeps its masks"


def test_masks_of_either_polarity_are_written_as_the_sequence_has_them(tmp_path, monkeypatch):
    data = write_tiny_sequence(tmp_path / "tiny")
    description = (data / "sequence.json").read_text()
    (data / "sequence.json").write_text(description.replace('"mask_tool_value": 255', '"mask_tool_value": 0'))
    mask = np.zeros((40, 48), bool)
    mask[:, 30:] = True
    monkeypatch.setattr(changed_copy, "find_in_sequence", lambda sequence: iter([(mask, FoundTools(mask, 1.0))] * 17))
    write_copy(load_sequence(data, DataConfig()), tmp_path / "copy", SequenceSpec(masks="found"))
    assert all((found == mask).all() for found in masks_of(tmp_path / "copy"))


def test_a_sequence_without_masks_is_one_clear_line(tmp_path, capsys):
    data = write_tiny_sequence(tmp_path / "tiny")
    for name in ("masks", "depth"):
        shutil.rmtree(data / name)
    (data / "poses_bounds.npy").unlink()  # now a plain folder, which needs no masks
    assert main(["bench", str(write_spec(tmp_path)), str(tmp_path / "out"), "--report-only"]) == 0
    said = [line for line in capsys.readouterr().out.splitlines() if line.startswith("note: ")]
    fix = "Fix: Add true masks, or remove `masks: found`."
    assert said == [
        f"note: tiny_found: {data}: expected a PNG mask per frame, to hide and to score against, got none. {fix}"
    ]
