"""Sequences with `poses: estimated`: what is trained in, what the path is compared with, what is an error."""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np
import pytest
import yaml
from benchmark_runs import contents, in_this_process
from conftest import write_tiny_sequence
from relief import HEIGHT, MATRIX, WIDTH, path, view

from endoprior.core.config import DataConfig
from endoprior.core.geometry import camera_to_world
from endoprior.data import FrameSequence, load_sequence
from endoprior.data.writer import SequenceMeta, new_sequence
from endoprior.evaluation.scorers.camera_path import trajectory_errors
from endoprior.prepare.camera_path import sequence_path as choose
from endoprior.tool_masks import FoundTools
from endoprior_studies import changed_copy
from endoprior_studies.matrix import run_matrix, scores_of
from endoprior_studies.method import PresetMethod
from endoprior_studies.report import write_report
from endoprior_studies.spec import Cell
from endoprior_studies.spec_file import load_spec

COUNT = 14
TRUE = path(COUNT, 1.3)
OWN, POSED, BOTH = (Cell(name, "m", None, 0) for name in ("clip", "clip_posed", "clip_both"))
QUICK = {"schedule.fine_iterations": 4, "schedule.coarse_iterations": 0, "init.budget": 200, "init.motion": "rest"}


def write_clip(folder: Path, poses: np.ndarray = TRUE, sources: dict[str, str] | None = None) -> Path:
    """A relief before a moving camera, without ground truth; a tool at the left side."""
    fx, cx, cy = MATRIX[0, 0], MATRIX[0, 2], MATRIX[1, 2]
    meta = SequenceMeta(
        WIDTH, HEIGHT, fx=fx, fy=fx, cx=cx, cy=cy, frames_per_second=25, depth_scale=0.01, sources=sources or {}
    )
    with new_sequence(folder, meta) as writer:
        for pose in TRUE:
            seen = view(pose)
            tool = ~seen.tissue_mask
            tool[50:70, :20] = True
            writer.add(seen.rgb_u8, tool, seen.depth)
        writer.camera_to_world = poses
    return folder


def write_spec(folder: Path) -> Path:
    clip = {"path": "clip"}
    values = {
        "title": "Posed",
        "sequences": {
            "clip": clip,
            "clip_posed": clip | {"poses": "estimated"},
            "clip_both": clip | {"poses": "estimated", "masks": "found"},
        },
        "methods": {"m": {}},
        "set": QUICK,
        "scores": ["psnr_tissue", "ate_mm", "rpe_deg", "mask_iou"],
        "figures": [],
    }
    spec = folder / "spec.yaml"
    spec.write_text(yaml.safe_dump(values))
    return spec


def path_of(sequence: FrameSequence) -> np.ndarray:
    return camera_to_world(map(sequence.camera, range(len(sequence))))


@pytest.fixture(scope="module", autouse=True)
def without_colmap():
    """Our own path, whether or not the package is there: it is faster."""
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(choose, "is_installed", lambda: False)
        yield


def empty_masks(sequence):
    mask = np.zeros((HEIGHT, WIDTH), bool)
    return iter([(mask, FoundTools(mask, 1.0))] * len(sequence))


@pytest.fixture(scope="module")
def finished(tmp_path_factory):
    """The matrix, camera paths and tissue that training got by sequence folder, what was said, and the files."""
    folder = tmp_path_factory.mktemp("posed")
    before, trained, said = contents(write_clip(folder / "clip")), {}, []

    def spy(method, sequence, options, **others):
        trained[sequence.path.name] = path_of(sequence), sequence.frame(0).tissue_mask.all()
        return train(method, sequence, options, **others)

    train = PresetMethod.train
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(PresetMethod, "train", spy)
        patch.setattr(changed_copy, "find_in_sequence", empty_masks)
        matrix = run_matrix(load_spec(write_spec(folder)), folder / "out", in_this_process, progress=said.append)
    assert not matrix.missing
    return matrix, trained, said, (before, contents(folder / "clip"))


@pytest.mark.slow
def test_training_gets_the_estimated_path_and_the_sequence_is_only_read(finished):
    matrix, trained, said, (before, after) = finished
    assert before == after and len(trained) == 3
    assert f"clip_posed: following the camera through {COUNT} frames" in said
    copies = sorted(copy.name for copy in (matrix.out / "sequences").iterdir())
    assert [name.rpartition("-")[0] for name in copies] == ["clip-estimated", "clip-found-estimated"]
    assert np.allclose(trained["clip"][0], TRUE)
    for name in copies:
        estimated, all_tissue = trained[name]
        copy = matrix.out / "sequences" / name
        errors = trajectory_errors(estimated, TRUE, with_scale=False)
        assert 0 < errors.ate_mm < 0.5, "of 18 mm"
        assert all_tissue == ("found" in name), "both parts are found where both are asked for"
        assert not (copy / "poses_bounds_before.npy").exists(), "the given poses are nowhere in the copy"
        assert json.loads((copy / "sequence.json").read_text())["sources"]["poses"] == "our own tracks"
        assert load_sequence(copy, DataConfig()).camera(0).fx == MATRIX[0, 0]


@pytest.mark.slow
def test_the_path_is_compared_with_the_given_one(finished):
    matrix, trained, _, _ = finished
    own, posed, both = (scores_of(matrix.done[cell]) for cell in (OWN, POSED, BOTH))
    (estimated,) = (poses for name, (poses, _) in trained.items() if name.startswith("clip-estimated"))
    assert posed["scores"]["ate_mm"] == pytest.approx(trajectory_errors(estimated, TRUE, False).ate_mm, rel=1e-6)
    assert "ate_mm" not in own["scores"], "it trains in the reference"
    assert posed["protocol"]["poses: estimated"].endswith("; found: our own tracks")
    assert "masks: found" not in posed["protocol"] and "mask_iou" not in posed["scores"]
    assert {"poses: estimated", "masks: found"} <= both["protocol"].keys() and both["scores"]["mask_iou"] == 0
    fingerprints = {scores["protocol"]["data_fingerprint"] for scores in (own, posed, both)}
    assert fingerprints == {load_sequence(matrix.data["clip"], DataConfig()).fingerprint()}


@pytest.mark.slow
def test_the_report_shows_what_the_estimated_path_costs(finished):
    matrix, _, _, _ = finished
    text = write_report(matrix, matrix.out).read_text()
    values = [scores_of(matrix.done[cell])["scores"]["psnr_tissue"] for cell in (OWN, POSED)]
    own, both, posed = text.split("\n## ")[1:4]
    assert "Paired" not in own
    assert "Paired difference to clip, which has its own poses, positive where better" in posed
    assert f"| m | {values[1] - values[0]:+.2f} dB |" in posed
    assert "Paired difference to clip, which has its own masks and poses," in both


@pytest.mark.parametrize("kind", ["still", "estimated", "layout"])
def test_nothing_to_compare_with_is_one_clear_line(tmp_path, kind):
    if kind == "layout":
        folder = write_tiny_sequence(tmp_path / "clip")
        (folder / "poses_bounds.npy").unlink()
        (folder / "depth").rename(folder / "depth_elsewhere")
        said = "expected a folder with images/, masks/, depth/ and poses_bounds.npy, got another layout. Fix: Remove"
    elif kind == "still":
        write_tiny_sequence(tmp_path / "clip")
        said = "clip: the camera does not move. Fix: Remove `poses: estimated`."
    else:
        write_clip(tmp_path / "clip", sources={"poses": "our own tracks"})
        said = "clip: expected given poses, to compare with, got those by our own tracks. Fix: Remove"
    matrix = run_matrix(load_spec(write_spec(tmp_path)), tmp_path / "out", lambda jobs: iter(()))
    assert said in matrix.missing[POSED] and OWN not in matrix.missing
    assert not (tmp_path / "out" / "sequences").exists()


def test_nothing_is_left_of_a_path_that_cannot_be_estimated(tmp_path, monkeypatch):
    def interrupted(*args, **options):
        raise KeyboardInterrupt

    write_clip(tmp_path / "clip")
    monkeypatch.setattr("endoprior.prepare.folder_path.sequence_path", interrupted)
    with pytest.raises(KeyboardInterrupt):
        run_matrix(load_spec(write_spec(tmp_path)), tmp_path / "out", in_this_process)
    assert not [*(tmp_path / "out" / "sequences").iterdir()]
