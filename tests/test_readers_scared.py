"""Processed SCARED keyframes of both versions: strides, depth from disparity, poses, principal point, mask rule."""

from __future__ import annotations

import json
import shutil

import cv2
import numpy as np
import pytest
from reader_checks import assert_damage_is_rejected, assert_rejected, edit_json, remark_with
from sequence_edits import write

from endoprior.core.checks import InputError
from endoprior.core.config import DataConfig
from endoprior.data import load_sequence
from endoprior.data.scared import dataset_number, disparity_to_depth, tissue_from_depth

WIDTH, HEIGHT, FRAMES = 24, 20, 9
KL = np.array([[30.0, 0, 13.25], [0, 31, 9.5], [0, 0, 1]])
BASELINE = 4.0
Q = np.array([[1, 0, 0, -13.25], [0, 1, 0, -9.5], [0, 0, 0, 30.0], [0, 0, 1 / BASELINE, 0]])
EVERY = DataConfig(stride=1)


def turn(degrees, axis=1):
    """Rotation about one axis, 4x4."""
    matrix, a = np.eye(4), np.radians(degrees)
    i, j = [k for k in range(3) if k != axis]
    matrix[i, i] = matrix[j, j] = np.cos(a)
    matrix[i, j], matrix[j, i] = -np.sin(a), np.sin(a)
    return matrix


def world_to_camera(frame):
    pose = turn(5 * frame) @ turn(20, 0)
    pose[:3, 3] = (frame, -2, 3)
    return pose


def turn_slightly(frame):
    """The world-to-camera of a camera that goes forward, aside and turns."""
    pose = turn(1.5 * frame) @ turn(frame, 0)
    pose[:3, 3] = (frame, 0.5 * frame, -6 * frame)
    return pose


RECTIFICATION = turn(3, 2)[:3, :3]


def write_keyframe(folder, version=1, frames=FRAMES):
    """Disparity 2 + frame / 8 px, so that depth is 120 / disparity mm; a hole of 3 x 3 px; color shows the frame."""
    data = folder / "data"
    for name in ("frame_data", "left_finalpass", "disparity", "reprojection_data"):
        (data / name).mkdir(parents=True)
    for i in range(frames):
        name = f"frame_data{i:06d}"
        record = {"camera-calibration": {"KL": KL.tolist()}, "camera-pose": world_to_camera(i).tolist()}
        (data / "frame_data" / f"{name}.json").write_text(json.dumps(record))
        write(data / "left_finalpass" / f"{name}.png", np.full((HEIGHT, WIDTH, 3), (3, 2, i), np.uint8))
        disparity = np.full((HEIGHT, WIDTH), 2 + i / 8, np.float32)
        disparity[5:8, 5:8] = 0
        disparity[0, 0], disparity[0, 1], disparity[0, 2] = -1, np.nan, 0.1  # 0.1 px is 1200 mm, beyond the range
        disparity[1, 0], disparity[1, 1] = 1, 8  # extremes that clipping to percentiles would change
        write(data / "disparity" / f"{name}.tiff", disparity)
        geometry = {"reprojection-matrix": Q.tolist()}
        if version == 2:
            left = np.column_stack([np.diag([40.0, 41, 1]), np.zeros(3)])
            left[:2, 2] = (11, 8)
            geometry = {
                "schema_version": 2,
                "image_size": [WIDTH, HEIGHT],
                "left_rectification_rotation": RECTIFICATION.tolist(),
                "left_projection_matrix": left.tolist(),
                "right_projection_matrix": left.tolist(),
                "reprojection_matrix": Q.tolist(),
            }
        (data / "reprojection_data" / f"{name}.json").write_text(json.dumps(geometry))
    return folder


@pytest.fixture
def keyframe(tmp_path):
    return write_keyframe(tmp_path / "dataset_1" / "keyframe_1")


def test_published_stride_and_its_override(keyframe):
    seq = load_sequence(keyframe)
    assert [seq.frame(i).rgb_u8[0, 0, 0] for i in range(len(seq))] == [0, 2, 4, 6, 8]
    assert (seq.frame(1).rgb_u8 == (2, 2, 3)).all()  # red first
    assert len(load_sequence(keyframe, EVERY)) == FRAMES
    part = load_sequence(keyframe, DataConfig(stride=4, first_frames=2))
    assert len(part) == 2 and part.frame(1).rgb_u8[0, 0, 0] == 4 and part.frame(1).time == 0.5


@pytest.mark.parametrize(
    ("folder", "number", "left"),
    [
        ("dataset_2/keyframe_1", 2, 9),
        ("scared/dataset3/keyframe_2", 3, 3),
        ("d6k1", 6, 2),
        ("dataset_1_keyframe_1", 1, 5),
        ("dataset_7_keyframe_1/half", 7, 2),
        ("dataset3_keyframe2", 3, 3),
        ("dataset_4/keyframe_1", 4, 9),
    ],
)
def test_stride_goes_by_the_datasets_number(tmp_path, folder, number, left):
    path = write_keyframe(tmp_path / folder)
    assert dataset_number(path) == number and len(load_sequence(path)) == left


def test_unknown_and_badly_calibrated_datasets_are_remarked(tmp_path):
    assert remark_with(write_keyframe(tmp_path / "mine"), "set data.stride")
    assert not remark_with(tmp_path / "mine", "set data.stride", EVERY)
    assert remark_with(write_keyframe(tmp_path / "dataset_5/keyframe_1"), "dataset 5 of SCARED is badly calibrated")


def test_depth_comes_from_disparity_and_is_not_clipped(keyframe):
    frame = load_sequence(keyframe, EVERY).frame(4)
    want = np.full((HEIGHT, WIDTH), 120 / 2.5, np.float32)
    want[5:8, 5:8] = 0
    want[0, :3] = 0
    want[1, :2] = 120, 15
    np.testing.assert_allclose(frame.depth, want, rtol=1e-6)  # float32 rounding
    np.testing.assert_array_equal(frame.depth_valid, want > 0)


def test_disparity_to_depth_by_hand():
    offset = Q.copy()
    offset[3, 3] = -0.25  # principal points one pixel apart: 30 / (d / 4 - 0.25)
    disparity = np.array([[0, 0.3, 0.5, 1, 2, 5, np.inf]], np.float32)
    np.testing.assert_allclose(disparity_to_depth(disparity, Q), [[0, 0, 240, 120, 60, 24, 0]], rtol=1e-6)
    np.testing.assert_allclose(disparity_to_depth(disparity, offset), [[0, 0, 0, 0, 120, 30, 0]], rtol=1e-6)


def test_mask_closes_gaps_of_the_width_over_128():
    depth = np.ones((64, 512), np.float32)  # squares of 4 px
    depth[20:23, 100:103] = 0
    depth[20:26, 200:206] = 0
    mask = tissue_from_depth(depth)
    assert mask[20:23, 100:103].all() and not mask[21:26, 201:206].any()
    assert mask[:, :50].all() and mask.mean() > 0.99


def test_version_1_camera_is_that_of_q_and_without_a_right_camera_poses_are_not_turned(keyframe):
    seq = load_sequence(keyframe)
    camera = seq.camera(2)  # frame 4 of the folder
    assert (camera.fx, camera.fy, camera.cx, camera.cy) == (30, 30, 13.75, 10)
    np.testing.assert_allclose(seq.camera(0).world_to_camera, np.eye(4), atol=1e-12)  # float64 rounding
    want = world_to_camera(4) @ np.linalg.inv(world_to_camera(0))
    np.testing.assert_allclose(camera.world_to_camera, want, atol=1e-12)
    assert remark_with(keyframe, "not turned")


@pytest.mark.parametrize("column", [False, True])
@pytest.mark.parametrize("alpha", [0, 0.7])
def test_static_points_land_on_themselves(tmp_path, column, alpha):
    """Two raw cameras that squint look at points; images are rectified as the public scripts do it."""
    size, rng = (640, 512), np.random.default_rng(0)
    left = np.array([[520.0, 0, 300], [0, 522, 260], [0, 0, 1]])
    right = np.array([[518.0, 0, 345], [0, 519, 251], [0, 0, 1]])
    turn, shift = cv2.Rodrigues(np.array([0.01, -0.03, 0.02]))[0], np.array([[-4.2], [0.05], [-0.1]])
    r1, _, p1, _, q, _, _ = cv2.stereoRectify(left, None, right, None, size, turn, shift, alpha=alpha)
    assert abs(p1[0, 2] - left[0, 2]) > 5  # where the raw principal point is wrong
    points = rng.uniform((-15, -12, 60), (15, 12, 90), (20, 3))  # in the world, mm
    poses = [turn_slightly(i) for i in range(3)]
    keyframe = write_keyframe(tmp_path / "dataset_2" / "keyframe_1", frames=3)
    for i, pose in enumerate(poses):
        raw = {"KL": left, "KR": right, "R": turn, "T": shift if column else shift[:, 0]}
        raw = {key: value.tolist() for key, value in raw.items()}
        edit_json(
            frame(keyframe, "frame_data", ".json", i), **{"camera-calibration": raw, "camera-pose": pose.tolist()}
        )
        edit_json(frame(keyframe, "reprojection_data", ".json", i), **{"reprojection-matrix": q.tolist()})
    seq = load_sequence(keyframe)
    assert not remark_with(keyframe, "not turned")

    def rectified(pose):
        """(P, 2) where the points are in the rectified image, integer centers, and their depth there."""
        at = (points @ pose[:3, :3].T + pose[:3, 3]) @ r1.T
        return (at[:, :2] / at[:, 2:]) * p1[0, 0] + p1[:2, 2], at[:, 2]

    places, depth = rectified(poses[0])
    camera = seq.camera(0)
    lifted = (
        np.column_stack(
            [(places[:, 0] + 0.5 - camera.cx) / camera.fx, (places[:, 1] + 0.5 - camera.cy) / camera.fy, np.ones(20)]
        )
        * depth[:, None]
    )
    for i in (1, 2):
        to = seq.camera(i)
        moved = lifted @ to.world_to_camera[:3, :3].T + to.world_to_camera[:3, 3]
        found = np.column_stack([moved[:, 0] / moved[:, 2] * to.fx + to.cx, moved[:, 1] / moved[:, 2] * to.fy + to.cy])
        np.testing.assert_allclose(found - 0.5, rectified(poses[i])[0], atol=1e-6)


def test_version_2_camera_is_the_rectified_one(tmp_path):
    keyframe = write_keyframe(tmp_path / "dataset_2" / "keyframe_1", version=2)
    camera = load_sequence(keyframe).camera(3)
    assert (camera.fx, camera.fy, camera.cx, camera.cy) == (40, 41, 11.5, 8.5)
    rotate = np.eye(4)
    rotate[:3, :3] = RECTIFICATION
    want = rotate @ world_to_camera(3) @ np.linalg.inv(rotate @ world_to_camera(0))
    np.testing.assert_allclose(camera.world_to_camera, want, atol=1e-12)
    assert not remark_with(keyframe, "not turned")


def test_skipping_every_frame_is_an_error(keyframe):
    with pytest.raises(InputError, match=r"data\.skip_frames: expected frames that leave some of 0 to 8, got 0-8\."):
        load_sequence(keyframe, DataConfig(stride=1, skip_frames="0-8"))


def test_fingerprint_follows_the_kept_frames(keyframe):
    before = load_sequence(keyframe).fingerprint()
    write(keyframe / "data/left_finalpass/frame_data000001.png", np.zeros((HEIGHT, WIDTH, 3), np.uint8))
    assert load_sequence(keyframe).fingerprint() == before
    edit_json(keyframe / "data/reprojection_data/frame_data000002.json", note=1)
    assert load_sequence(keyframe).fingerprint() != before


def frame(folder, name, suffix, number=2):
    return folder / "data" / name / f"frame_data{number:06d}{suffix}"


def nan_pose(folder):
    edit_json(frame(folder, "frame_data", ".json"), **{"camera-pose": np.full((4, 4), np.nan).tolist()})


def bad_record(key, value):
    return lambda f: edit_json(frame(f, "frame_data", ".json"), **{key: value})


def bad_geometry(key, value):
    return lambda f: edit_json(frame(f, "reprojection_data", ".json"), **{key: value})


RAW = {"KL": KL.tolist(), "KR": KL.tolist(), "R": np.eye(3).tolist()}
RECORD, GEOMETRY = "frame_data/frame_data000002.json", "reprojection_data/frame_data000002.json"
BAD = {
    "raw": (lambda f: shutil.rmtree(f / "data/disparity"), "data/disparity", "no such folder"),
    "counts": (lambda f: frame(f, "disparity", ".tiff").unlink(), "disparity", "9 frames of frame_data, got 8"),
    "names": (
        lambda f: frame(f, "left_finalpass", ".png").rename(frame(f, "left_finalpass", ".png", 77)),
        "left_finalpass",
        "frame_data000002 is in one",
    ),
    "no pose": (bad_record("camera-pose", None), RECORD, "camera-pose, 4x4 numbers, got no such key"),
    "calibration text": (bad_record("camera-calibration", dict.fromkeys("KL KR R T".split(), "x")), RECORD, "n.KL"),
    "right camera": (bad_record("camera-calibration", RAW | {"T": [0, 0, 0]}), RECORD, "T of 0 mm"),
    "shift": (bad_record("camera-calibration", RAW | {"T": [1, 2]}), RECORD, "T, 1x3 numbers"),
    "ragged shift": (bad_record("camera-calibration", RAW | {"T": [[1], [2, 3]]}), RECORD, "T, 1x3 numbers"),
    "pose NaN": (nan_pose, RECORD, "NaN or infinity"),
    "pose scaled": (bad_record("camera-pose", (2 * np.eye(4)).tolist()), "data/frame_data", "rotations in camera-pose"),
    "focal zero": (bad_geometry("reprojection-matrix", np.eye(4).tolist()), GEOMETRY, "focal lengths > 0"),
    "no Q": (bad_geometry("reprojection-matrix", None), GEOMETRY, "reprojection-matrix"),
    "Q of other shape": (bad_geometry("reprojection-matrix", [[1]]), GEOMETRY, "got shape (1, 1)"),
    "version 3": (bad_geometry("schema_version", 3), GEOMETRY, "schema_version 1 or 2, got 3"),
    "broken json": (lambda f: frame(f, "reprojection_data", ".json").write_text("{"), GEOMETRY, "a JSON object"),
    "image cut": (
        lambda f: frame(f, "left_finalpass", ".png").write_bytes(frame(f, "left_finalpass", ".png").read_bytes()[:40]),
        "left_finalpass/frame_data000002.png",
        "cannot be decoded",
    ),
    "disparity size": (
        lambda f: write(frame(f, "disparity", ".tiff"), np.ones((4, 5), np.float32)),
        "disparity/frame_data000002.tiff",
        "got 5x4",
    ),
}


BAD["raw and packed"] = (
    lambda f: (shutil.rmtree(f / "data/frame_data"), (f / "data/frame_data.tar.gz").touch()),
    "data/frame_data",
    "Process the keyframe first, see docs/datasets.md.",
)


@pytest.mark.parametrize("case", BAD)
def test_bad_keyframes_are_rejected(keyframe, case):
    assert_damage_is_rejected(keyframe, *BAD[case])


def test_mixed_versions_are_rejected(keyframe, tmp_path):
    other = write_keyframe(tmp_path / "two", version=2)
    shutil.copy(frame(other, "reprojection_data", ".json"), frame(keyframe, "reprojection_data", ".json"))
    assert_rejected(keyframe, "reprojection_data", "files of one version, got versions 1 and 2")
    edit_json(frame(other, "reprojection_data", ".json"), image_size=[1280, 1024])
    assert_rejected(other, GEOMETRY, "image_size [24, 20]")
