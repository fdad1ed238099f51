"""`endoprior poses DATA`: new poses in the folder, the originals beside them, depth at the scale of the path."""

import json
import shutil

import numpy as np
import pytest
from relief import HEIGHT, MATRIX, WIDTH, path, view

from endoprior.cli import main
from endoprior.core.config import DataConfig
from endoprior.data import load_sequence
from endoprior.data.images import decode_image
from endoprior.data.writer import SequenceMeta, new_sequence

COUNT = 16
TRUE = path(COUNT, 1.3)


def write(out, relative):
    focal = dict(fx=MATRIX[0, 0], fy=MATRIX[1, 1], cx=MATRIX[0, 2], cy=MATRIX[1, 2])
    sources = {"depth": "shading" if relative else "rendered", "lens": "calibration"}
    meta = SequenceMeta(
        WIDTH, HEIGHT, **focal, frames_per_second=25, baseline_mm=None if relative else 4.0, depth_scale=0.01,
        depth_relative=relative, sources=sources,
    )  # fmt: skip
    with new_sequence(out, meta) as writer:
        for i, pose in enumerate(TRUE):
            seen = view(pose)
            factor = np.float32(1 + 0.3 * np.sin(i) if relative else 1)
            writer.add(seen.rgb_u8, ~seen.tissue_mask, seen.depth * factor)
        if not relative:
            writer.write_array("truth/camera_to_world.npy", TRUE)
    return out


@pytest.fixture(scope="module")
def metric(tmp_path_factory):
    """Left as it is: depth in mm, static poses."""
    return write(tmp_path_factory.mktemp("metric") / "DATA", False)


@pytest.fixture(scope="module")
def relative(tmp_path_factory):
    """Left as it is: depth of another scale in each frame."""
    return write(tmp_path_factory.mktemp("relative") / "DATA", True)


@pytest.fixture
def folder(metric, tmp_path):
    """A copy of it."""
    return shutil.copytree(metric, tmp_path / "DATA")


def depth_ratios(folder):
    """(T,) median stored depth over that which the camera truly sees."""
    stored = [decode_image(file, None).astype(float) * 0.01 for file in sorted((folder / "depth").glob("*.png"))]
    return np.array([np.median(d / view(p).depth) for d, p in zip(stored, TRUE, strict=True)])


def poses_of(folder):
    return np.load(folder / "poses_bounds.npy")[:, :15].reshape(-1, 3, 5)


def described(folder):
    return json.loads((folder / "sequence.json").read_text())


def test_poses_are_found_and_the_originals_kept(metric, folder, capsys):
    assert main(["poses", str(folder), "--poses", "own"]) == 0
    said = capsys.readouterr().out
    assert "against the true path" in said and "aligned by SE(3)" in said and "poses_bounds_before.npy" in said
    found = poses_of(folder)
    assert np.linalg.norm(found[:, :, 3] - TRUE[:, :3, 3], axis=1).max() < 0.5  # of 21 mm
    assert np.allclose(found[:, :, 4], [HEIGHT, WIDTH, MATRIX[0, 0]])
    assert (folder / "poses_bounds_before.npy").read_bytes() == (metric / "poses_bounds.npy").read_bytes()
    facts, before = described(folder), described(metric)
    assert facts["sources"] == before["sources"] | {"poses": "our own tracks", "camera motion": "translating"}
    assert facts["unexplained_frames"] == []
    record = json.loads((folder / "camera_path.json").read_text())
    assert record["method"] == "our own tracks" and len(record["translation_std_mm"]) == COUNT
    assert 0 < np.median(record["translation_std_mm"]) < 1
    for name in ("images", "masks", "depth"):
        for file in (metric / name).iterdir():
            assert (folder / name / file.name).read_bytes() == file.read_bytes()
    load_sequence(folder, DataConfig()).validate()
    first = (folder / "poses_bounds.npy").read_bytes()
    assert main(["poses", str(folder), "--poses", "own"]) == 0  # again: the same, and no new backup
    assert (folder / "poses_bounds.npy").read_bytes() == first
    assert (folder / "poses_bounds_before.npy").read_bytes() == (metric / "poses_bounds.npy").read_bytes()


@pytest.mark.slow
def test_relative_depth_is_brought_to_the_path_also_twice(relative, tmp_path):
    folder = shutil.copytree(relative, tmp_path / "DATA")
    assert np.ptp(depth_ratios(folder)) > 0.5
    assert main(["poses", str(folder), "--poses", "own"]) == 0
    once = depth_ratios(folder)
    assert np.ptp(once) / once.mean() < 0.03
    reach = np.linalg.norm(poses_of(folder)[:, :, 3], axis=1).max()
    assert main(["poses", str(folder), "--poses", "own"]) == 0
    twice = depth_ratios(folder)
    assert np.ptp(twice) / twice.mean() < 0.03 and twice.mean() == pytest.approx(once.mean(), rel=0.05)
    assert np.linalg.norm(poses_of(folder)[:, :, 3], axis=1).max() == pytest.approx(reach, rel=0.1)
    assert not list(folder.glob(".*"))


def test_given_poses_scale_relative_depth(relative, tmp_path):
    folder = shutil.copytree(relative, tmp_path / "DATA")
    np.save(tmp_path / "true.npy", TRUE)
    assert main(["poses", str(folder), "--poses", str(tmp_path / "true.npy")]) == 0
    assert np.allclose(depth_ratios(folder), 1, atol=0.03)
    assert np.allclose(poses_of(folder)[:, :, :4], TRUE[:, :3])
    assert described(folder)["sources"]["poses"] == "file"


def test_depth_that_the_old_path_measured_is_said(relative, tmp_path, capsys):
    np.save(tmp_path / "true.npy", TRUE)
    for measured in (False, True):
        folder = shutil.copytree(relative, tmp_path / f"DATA{measured:d}")
        if measured:
            (folder / "depth_confidence").mkdir()
        assert main(["poses", str(folder), "--poses", str(tmp_path / "true.npy")]) == 0
        assert ("measured by parallax with the path before" in "".join(capsys.readouterr())) == measured


@pytest.mark.parametrize(("source", "kept"), [("file", True), ("SLAM", True), ("COLMAP", False)])
def test_only_estimated_poses_are_replaced_without_a_copy(folder, source, kept):
    facts = described(folder)
    (folder / "sequence.json").write_text(json.dumps(facts | {"sources": facts["sources"] | {"poses": source}}))
    assert main(["poses", str(folder), "--poses", "still"]) == 0
    assert (folder / "poses_bounds_before.npy").exists() == kept
    assert np.allclose(poses_of(folder)[:, :, :4], np.eye(4)[:3])
    assert described(folder)["sources"]["poses"] == "static camera" and not (folder / "camera_path.json").exists()


def test_a_folder_without_poses(folder):
    (folder / "poses_bounds.npy").unlink()
    assert main(["poses", str(folder), "--poses", "own"]) == 0
    assert len(load_sequence(folder, DataConfig())) == COUNT and not (folder / "poses_bounds_before.npy").exists()


@pytest.mark.parametrize("kind", ["no depth", "no focal", "missing file", "wrong count", "read-only"])
def test_bad_input_gives_one_line_and_changes_nothing(folder, tmp_path, kind, capsys, monkeypatch):
    options = ["--poses", "own"]
    if kind == "no depth":
        shutil.rmtree(folder / "depth")
    elif kind == "no focal":
        (folder / "sequence.json").unlink()
        (folder / "poses_bounds.npy").unlink()
    elif kind == "missing file":
        options = ["--poses", str(tmp_path / "none.npy")]
    elif kind == "wrong count":
        np.save(tmp_path / "few.npy", TRUE[:3])
        options = ["--poses", str(tmp_path / "few.npy")]
    else:
        monkeypatch.setattr("endoprior.data.edit.os.access", lambda *args: False)
    before = {file: file.read_bytes() for file in folder.rglob("*") if file.is_file()}
    assert main(["poses", str(folder), *options]) == 2
    said = capsys.readouterr().err.strip().splitlines()
    assert len(said) == 1 and "expected" in said[0] and "Fix:" in said[0]
    assert {file: file.read_bytes() for file in folder.rglob("*") if file.is_file()} == before
