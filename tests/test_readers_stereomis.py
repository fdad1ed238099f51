"""StereoMIS: the prepared layout with split.json and intrinsics.npy; raw folders are told what to do."""

from __future__ import annotations

import json
import re
import shlex
import shutil

import cv2
import numpy as np
import pytest
from known_surface import color_change, off_the_plane, pose, seen_through_lens, turned
from reader_checks import assert_damage_is_rejected, assert_rejected, edit_json, remark_with
from scipy.spatial.transform import Rotation
from sequence_edits import change_poses, write
from video_files import write_video

from endoprior.cli import main
from endoprior.core.checks import InputError
from endoprior.core.config import DataConfig
from endoprior.data import load_sequence
from endoprior.prepare.camera_path.pose_file import read_poses

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
    options = f"--calibration {tmp_path / 'StereoCalibration.ini'} --layout top-bottom --masks {tmp_path / 'masks'}"
    words = f"`endoprior prepare {tmp_path / 'VIDEO.mp4'} OUT {options} --mask-tool-value low`"
    assert_rejected(tmp_path, "StereoCalibration.ini", words)


def raw_sequence(folder, frames=9):
    """A stereo camera with distortion that moves over the plane, in the layout of the raw dataset.

    Returns camera-to-world of the left camera and R1, its turn by the rectification.
    """
    left, right = (
        np.array([[300.0, 0, 165], [0, 302, 120], [0, 0, 1]]),
        np.array([[298.0, 0, 150], [0, 299, 131], [0, 0, 1]]),
    )
    bent, turn, shift = np.array([-0.1, 0.02, 0, 0, 0]), turned(1.0, -3.0, 0.6), np.array([-4.2, 0.5, -0.3])
    ini = {"StereoLeft": (left, bent), "StereoRight": (right, bent)}
    lines = []
    for name, (matrix, lens) in ini.items():
        camera = {"res_x": 320, "res_y": 256, "fc_x": matrix[0, 0], "fc_y": matrix[1, 1], "cc_x": matrix[0, 2]}
        camera |= {"cc_y": matrix[1, 2]} | {f"kc_{i}": value for i, value in enumerate([*lens, 0, 0, 0])}
        if name == "StereoRight":
            camera |= {f"R_{i}": value for i, value in enumerate(turn.ravel())}
            camera |= {f"T_{i}": value for i, value in enumerate(shift)}
        lines += [f"[{name}]", *(f"{key}={float(value)!r}" for key, value in camera.items())]
    (folder / "masks").mkdir(parents=True)
    (folder / "StereoCalibration.ini").write_text("\n".join(lines))
    to_right = np.vstack([np.column_stack([turn, shift]), (0, 0, 0, 1)])
    poses = [pose(turned(0.5 * i, -0.7 * i, 1.5 * i), (1.5 * i, -0.8 * i, 0.9 * i)) for i in range(frames)]
    pictures, rows = [], []
    for i, to_world in enumerate(poses):
        views = [(left, to_world), (right, to_world @ np.linalg.inv(to_right))]
        colors = [seen_through_lens(matrix, bent, axes, (320, 256))[0] for matrix, axes in views]
        pictures.append(np.vstack(colors))
        quaternion = Rotation.from_matrix(to_world[:3, :3]).as_quat()
        rows.append([i + 1, *(to_world[:3, 3] / 1000), *quaternion])
        if i % 2 == 0:
            tissue = np.full((256, 320), 255, np.uint8)
            tissue[100:140, 200:] = 0
            write(folder / f"masks/{i + 1:06d}l.png", tissue)
    np.savetxt(folder / "groundtruth.txt", rows, fmt=["%d"] + 7 * ["%.9f"])
    write_video(folder / "P1.mp4", pictures)
    return poses, cv2.stereoRectify(
        left, bent, right, bent, (320, 256), turn, shift[:, None], flags=cv2.CALIB_ZERO_DISPARITY, alpha=0
    )[0]


@pytest.mark.slow
def test_a_raw_sequence_lands_on_itself(tmp_path, capsys):
    """The printed command as it is: masks of every second frame, poses in m, turned by the rectification."""
    poses, turn = raw_sequence(tmp_path / "P1")
    assert np.degrees(np.arccos((np.trace(turn) - 1) / 2)) > 6
    with pytest.raises(InputError) as caught:
        load_sequence(tmp_path / "P1")
    words = shlex.split(str(caught.value).split("`")[1])
    words[words.index("OUT")] = str(tmp_path / "out")
    assert main(words[1:]) == 0
    said = capsys.readouterr()
    said = said.out + said.err
    assert "masks: one for every 2 frames; 4 of 9 frames have none and are left out" in said
    assert "they are turned as its images are, by" in said
    seq = load_sequence(tmp_path / "out")
    assert len(seq) == 5 and seq.frames_per_second == 12.5
    tool = 1 - np.mean([frame.tissue_mask.mean() for frame in seq.frames("video")])
    assert 0.03 < tool < 0.12  # 40x120 of 320x256 px, and the rim
    for i, to_world in enumerate(poses[::2]):
        turned_back = np.eye(4)
        turned_back[:3, :3] = turn.T
        want = np.linalg.inv(to_world @ turned_back)
        np.testing.assert_allclose(seq.camera(i).world_to_camera, want, atol=1e-4)  # groundtruth.txt is rounded
        assert off_the_plane(seq, i) < 1.5  # mm; semi-global matching
    assert color_change(seq, 0, 4) < 25  # of about 150 levels


def test_poses_of_a_video_are_no_poses_of_frames(tiny_sequence, tmp_path, capsys):
    (tmp_path / "groundtruth.txt").write_text("1 0 0 0 0 0 0 1\n")
    assert main(["poses", str(tiny_sequence), "--poses", str(tmp_path / "groundtruth.txt")]) == 2
    assert "Pass it to `endoprior prepare VIDEO OUT --poses`" in capsys.readouterr().err


TEXT = {
    "numbers from 0": ([0, 1, 2, 3], [1, 3], [1, 3]),
    "numbers from 1": ([1, 2, 3, 4], [1, 3], [1, 3]),
    "every second number": ([1, 3, 5], [0, 4], [0, 2]),
    "a part": ([7, 8, 9], [6, 8], [0, 2]),
    "times": ([1.5, 1.6, 1.7], [0, 2], [0, 2]),
}


@pytest.mark.parametrize("case", TEXT)
def test_rows_belong_to_images_by_number_or_in_order(tmp_path, case):
    numbers, images, rows = TEXT[case]
    lines = [f"{number} {row / 1000} 0 0 0 0 0 1" for row, number in enumerate(numbers)]
    (tmp_path / "poses.txt").write_text("# frame x y z qx qy qz qw\n" + "\n".join(lines))
    poses = read_poses(tmp_path / "poses.txt", len(images), images)
    np.testing.assert_allclose(poses[:, 0, 3], rows, atol=1e-9)


BAD_TEXT = {
    "a missing image": (
        "1 0 0 0 0 0 0 1",
        "a row for each image of the video that is used, got 1 rows, none for image 2",
    ),
    "7 numbers": ("0 0 0 0 0 0 1\n0 0 0 0 0 0 1", "rows of 8 or 12 numbers, got 7"),
    "zero quaternion": ("1 0 0 0 0 0 0 0\n2 0 0 0 0 0 0 1", "quaternions of length 1, got length 0 of that of frame 0"),
    "mm": ("1 0 0 0 0 0 0 1\n2 30 0 0 0 0 0 1", "positions in m, within 2 m, got a path that reaches 30"),
}


@pytest.mark.parametrize("case", BAD_TEXT)
def test_bad_poses_of_a_video_are_rejected(tmp_path, case):
    text, words = BAD_TEXT[case]
    (tmp_path / "poses.txt").write_text(text)
    with pytest.raises(InputError, match=re.escape(words)):
        read_poses(tmp_path / "poses.txt", 2, [0, 1])


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
    assert_damage_is_rejected(prepared, *BAD[case])
