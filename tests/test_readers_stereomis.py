"""StereoMIS: the prepared layout with split.json and intrinsics.npy; raw folders are told what to do."""

from __future__ import annotations

import json
import shutil

import cv2
import numpy as np
import pytest
from reader_checks import assert_rejected, edit_json, remark_with
from sequence_edits import change_poses, write

from endoprior.core.config import DataConfig
from endoprior.data import load_sequence

MATRIX = np.array([[61.0, 0, 22.5], [0, 62, 18.25], [0, 0, 1]])


@pytest.fixture
def prepared(tiny_sequence):
    """The tiny sequence as EndoPrior-GS prepares StereoMIS: 17 frames, 8-bit relative depth, test frames 1 and 9."""
    (tiny_sequence / "sequence.json").unlink()
    test = [1, 9]
    split = {"sequence": "P2_7", "train_indices": [i for i in range(17) if i not in test], "test_indices": test}
    (tiny_sequence / "split.json").write_text(json.dumps(split))
    np.save(tiny_sequence / "intrinsics.npy", MATRIX)
    for file in (tiny_sequence / "depth").iterdir():
        write(file, np.full((40, 48), 100 + int(file.stem), np.uint8))

    def move(poses):
        poses[3, :15].reshape(3, 5)[:, 3] = (4, 5, 6)  # mm
        return poses

    change_poses(tiny_sequence, move)
    return tiny_sequence


def test_camera_is_the_rectified_one(prepared):
    camera = load_sequence(prepared).camera(3)
    assert (camera.fx, camera.fy, camera.cx, camera.cy) == (61, 62, 23, 18.75)
    np.testing.assert_allclose(camera.center, (4, 5, 6), atol=1e-12)


def test_without_intrinsics_the_stored_focal_length_counts(prepared):
    (prepared / "intrinsics.npy").unlink()
    camera = load_sequence(prepared).camera(0)
    assert (camera.fx, camera.fy, camera.cx, camera.cy) == (50, 50, 24, 20)


def test_eight_bit_depth_is_relative(prepared):
    seq = load_sequence(prepared)
    assert seq.depth_is_relative and seq.sources == {"depth": "Omnidata, relative, 8 bits"}
    assert (seq.frame(7).depth == 107).all() and remark_with(prepared, "scale of its depth is unknown")


def test_sixteen_bit_depth_is_metric(prepared):
    for file in (prepared / "depth").iterdir():
        write(file, cv2.imread(str(file), cv2.IMREAD_UNCHANGED).astype(np.uint16))
    seq = load_sequence(prepared)
    assert not seq.depth_is_relative and seq.sources == {}


def test_split_and_masks(prepared):
    seq = load_sequence(prepared)
    assert seq.indices("test") == [1, 9]
    tool = cv2.imread(str(prepared / "masks/000002.png"), cv2.IMREAD_UNCHANGED) == 255
    np.testing.assert_array_equal(seq.frame(2).tissue_mask, ~tool)
    assert len(load_sequence(prepared, DataConfig(first_frames=5))) == 5


def test_fingerprint_knows_the_calibration(prepared):
    before = load_sequence(prepared).fingerprint()
    np.save(prepared / "intrinsics.npy", MATRIX + np.diag([1, 0, 0]))
    assert load_sequence(prepared).fingerprint() != before


def test_raw_sequence_is_sent_to_prepare(tmp_path):
    (tmp_path / "masks").mkdir()
    (tmp_path / "StereoCalibration.ini").write_text("[StereoLeft]\n")
    assert_rejected(tmp_path, "StereoCalibration.ini", "Run endoprior prepare on its video")


BAD = {
    "other split": (
        lambda f: edit_json(f / "split.json", test_indices=[0, 8]),
        "split.json",
        "test_indices of the rule (i - 1) % 8 == 0, 2 frames, got 2 frames that differ. Fix: Remove split.json",
    ),
    "missing key": (lambda f: edit_json(f / "split.json", train_indices=None), "split.json", "a list train_indices"),
    "broken split": (lambda f: (f / "split.json").write_text("["), "split.json", "a JSON object"),
    "fewer masks": (lambda f: (f / "masks/000003.png").unlink(), "masks", "17 files, one per image, got 16"),
    "no depth": (lambda f: shutil.rmtree(f / "depth"), "depth", "no such folder"),
    "matrix shape": (lambda f: np.save(f / "intrinsics.npy", np.eye(4)), "intrinsics.npy", "shape (4, 4)"),
    "matrix zero": (lambda f: np.save(f / "intrinsics.npy", np.zeros((3, 3))), "intrinsics.npy", "a 3x3 camera"),
    "matrix NaN": (lambda f: np.save(f / "intrinsics.npy", MATRIX * np.nan), "intrinsics.npy", "a 3x3 camera matrix"),
    "pose NaN": (lambda f: change_poses(f, lambda p: p * np.nan), "poses_bounds.npy", "finite numbers"),
    "depth cut": (lambda f: (f / "depth/000000.png").write_bytes(b"x"), "depth/000000.png", "cannot be decoded"),
}


@pytest.mark.parametrize("case", BAD)
def test_bad_sequences_are_rejected(prepared, case):
    damage, named, words = BAD[case]
    damage(prepared)
    assert_rejected(prepared, named, words)
