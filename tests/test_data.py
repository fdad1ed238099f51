"""Reading sequences: layout, cameras, split, cleaning of depth, fingerprint, truth."""

from __future__ import annotations

import shutil

import cv2
import numpy as np
import pytest
from sequence_edits import change_poses, describe, write

from endoprior.core.checks import InputError
from endoprior.core.config import DataConfig
from endoprior.core.geometry import back_project, project
from endoprior.data import Truth, clean_depth, load_sequence, pixels


def rotation_about(axis: int, degrees: float) -> np.ndarray:
    c, s = np.cos(np.radians(degrees)), np.sin(np.radians(degrees))
    rotation = np.eye(3)
    a, b = [i for i in range(3) if i != axis]
    rotation[a, a] = rotation[b, b] = c
    rotation[a, b], rotation[b, a] = -s, s
    return rotation


# --- what is read


def test_frames_are_what_the_files_say(tiny_sequence):
    seq = load_sequence(tiny_sequence)
    assert len(seq) == 17 and seq.frames_per_second == 15 and seq.path == tiny_sequence and seq.truth is None
    frame = seq.frame(3)
    stored = cv2.imread(str(tiny_sequence / "images/000003.png"))
    np.testing.assert_array_equal(frame.rgb_u8, stored[..., ::-1])
    tool = cv2.imread(str(tiny_sequence / "masks/000003.png"), cv2.IMREAD_UNCHANGED)
    np.testing.assert_array_equal(frame.tissue_mask, tool == 0)
    assert 0 < (~frame.tissue_mask).mean() < 0.3
    assert frame.index == 3 and frame.time == 3 / 17
    assert not frame.depth_valid[:4, :5].any() and frame.depth_valid.sum() == frame.depth.size - 20
    assert (frame.depth[frame.depth_valid] > 40).all() and not frame.depth[~frame.depth_valid].any()
    assert (frame.camera.width, frame.camera.height) == (48, 40)
    assert (frame.camera.fx, frame.camera.fy, frame.camera.cx, frame.camera.cy) == (50, 50, 24, 20)
    np.testing.assert_array_equal(frame.camera.world_to_camera, np.eye(4))
    assert frame.rgb_u8.dtype == np.uint8 and frame.tissue_mask.dtype == bool
    assert frame.depth.dtype == np.float32 and frame.depth_valid.dtype == bool


def test_frames_are_decoded_once_and_only_when_used(tiny_sequence):
    seq = load_sequence(tiny_sequence)
    train = seq.frames("train")
    first = seq.frame(0)
    shutil.rmtree(tiny_sequence / "images")
    assert seq.frame(0) is first and train[0] is first
    with pytest.raises(InputError, match=r"000002\.png"):
        train[1]


@pytest.mark.parametrize(
    ("num_frames", "test"),
    [(2, [1]), (9, [1]), (10, [1, 9]), (63, [1, 9, 17, 25, 33, 41, 49, 57]), (156, list(range(1, 156, 8)))],
)
def test_split(make_tiny_sequence, num_frames, test):
    seq = load_sequence(make_tiny_sequence(num_frames=num_frames, width=4, height=4))
    assert seq.indices("test") == test
    assert seq.indices("train") == [i for i in range(num_frames) if i not in test]
    assert seq.indices("video") == list(range(num_frames))
    assert [frame.index for frame in seq.frames("test")] == test
    assert len(seq.frames("train")) == num_frames - len(test)


def test_frame_list_is_a_list(tiny_sequence):
    frames = load_sequence(tiny_sequence).frames("train")
    assert frames[-1].index == 16 and frames[1].index == 2
    assert [frame.index for frame in frames[:3]] == [0, 2, 3]
    with pytest.raises(IndexError):
        frames[len(frames)]
    assert next(reversed(frames)).index == 16


def test_unknown_split_and_frame_and_axes(tiny_sequence):
    seq = load_sequence(tiny_sequence)
    with pytest.raises(ValueError, match="split must be train, test or video; got 'val'"):
        seq.indices("val")
    for index in (-1, 17):
        with pytest.raises(IndexError, match=r"0\.\.16"):
            seq.frame(index)
    with pytest.raises(ValueError, match="pose_axes"):
        load_sequence(tiny_sequence, pose_axes="llff")


def test_intrinsics_without_description(tiny_sequence):
    (tiny_sequence / "sequence.json").unlink()
    change_poses(tiny_sequence, lambda p: np.where(np.arange(17) == 14, 71.5, p))
    seq = load_sequence(tiny_sequence)
    camera = seq.camera(5)
    assert (camera.fx, camera.fy, camera.cx, camera.cy) == (71.5, 71.5, 24, 20)
    assert seq.frames_per_second is None
    assert seq.frame(0).depth.max() > 1000  # depth_scale 1: the stored hundredths of a millimeter as they stand


def test_poses_are_camera_to_world(tiny_sequence):
    rotation, center = rotation_about(1, 30) @ rotation_about(0, 10), np.array([3.0, -2, 7])

    def change(poses):
        poses[2, :15].reshape(3, 5)[:, :4] = np.column_stack([rotation, center])
        return poses

    change_poses(tiny_sequence, change)
    camera = load_sequence(tiny_sequence).camera(2)
    np.testing.assert_allclose(camera.center, center, atol=1e-12)  # float64 rounding
    ahead = center + 10 * rotation[:, 2]  # the third column looks forward
    pixel, z = project(ahead, camera)
    np.testing.assert_allclose([*pixel, z], [24, 20, 10], atol=1e-12)
    right, _ = project(ahead + rotation[:, 0], camera)
    assert right[0] > 24 and abs(right[1] - 20) < 1e-9
    lifted = back_project(np.array([10.5, 30.5]), np.array(60.0), camera)
    np.testing.assert_allclose(project(lifted, camera)[0], [10.5, 30.5], atol=1e-10)


def test_opengl_poses_look_along_minus_z(tiny_sequence):
    rotation = rotation_about(2, 20)

    def change(poses):
        poses[0, :15].reshape(3, 5)[:, :4] = np.column_stack([rotation, np.array([1, 2, 3])])
        return poses

    change_poses(tiny_sequence, change)
    camera = load_sequence(tiny_sequence, pose_axes="opengl").camera(0)
    np.testing.assert_allclose(camera.center, [1, 2, 3], atol=1e-12)
    pixel, z = project(camera.center - 10 * rotation[:, 2] + rotation[:, 1], camera)
    assert z == pytest.approx(10) and pixel[1] < 20  # y up in the pose, up in the image


def test_gt_masks_only_by_option(tiny_sequence):
    shutil.copytree(tiny_sequence / "masks", tiny_sequence / "gt_masks")
    for file in (tiny_sequence / "gt_masks").iterdir():
        write(file, np.zeros((40, 48), np.uint8))
    assert not load_sequence(tiny_sequence).frame(0).tissue_mask.all()
    assert load_sequence(tiny_sequence, DataConfig(use_gt_masks=True)).frame(0).tissue_mask.all()


def test_masks_and_depth_with_equal_channels_and_images_with_alpha(tiny_sequence):
    want = load_sequence(tiny_sequence).frame(0)
    for name in ("masks", "depth"):
        file = tiny_sequence / name / "000000.png"
        write(file, np.repeat(cv2.imread(str(file), cv2.IMREAD_UNCHANGED)[..., None], 3, 2))
    file = tiny_sequence / "images/000000.png"
    write(file, cv2.cvtColor(cv2.imread(str(file)), cv2.COLOR_BGR2BGRA))
    got = load_sequence(tiny_sequence).frame(0)
    for field in ("rgb_u8", "tissue_mask", "depth", "depth_valid"):
        np.testing.assert_array_equal(getattr(got, field), getattr(want, field))


def test_eight_bit_depth_in_millimeters(tiny_sequence):
    describe(tiny_sequence, depth_scale=None)
    write(tiny_sequence / "depth/000000.png", np.full((40, 48), 73, np.uint8))
    assert (load_sequence(tiny_sequence).frame(0).depth == 73).all()


def test_numbers_in_names_sort_as_numbers(tiny_sequence):
    for name in ("images", "masks", "depth"):
        for i, file in enumerate(sorted((tiny_sequence / name).iterdir())):
            file.rename(file.with_name(f"f{i}.{name}.png"))
        (tiny_sequence / name / "._f0.png").write_bytes(b"left by another system")
    write(tiny_sequence / "images/f10.images.png", np.full((40, 48, 3), 10, np.uint8))
    seq = load_sequence(tiny_sequence)
    assert (seq.frame(10).rgb_u8 == 10).all() and seq.validate() == []


# --- depth cleaning


def test_depth_is_clipped_to_percentiles_of_its_valid_values(monkeypatch):
    monkeypatch.setattr(pixels, "CLIP_PERCENTILES", (3, 98))
    raw = np.zeros((10, 101), np.float32)
    raw[0] = np.arange(101) + 1.0  # percentile p is p + 1
    depth, valid = clean_depth(raw)
    np.testing.assert_array_equal(depth[0], np.clip(raw[0], 4, 99))
    assert valid[0].all() and not valid[1:].any() and not depth[1:].any()


def test_missing_depth_in_every_form():
    raw = np.array([[5, 0, -1, np.nan, np.inf, -np.inf]], np.float32)
    depth, valid = clean_depth(raw)
    np.testing.assert_array_equal(valid, [[True, False, False, False, False, False]])
    np.testing.assert_array_equal(depth, [[5, 0, 0, 0, 0, 0]])


def test_legacy_lift_makes_missing_depth_near():
    raw = np.append(np.arange(101) + 1.0, [0, np.nan]).astype(np.float32)[None]
    depth, valid = clean_depth(raw, DataConfig(lift_missing_depth=True))
    assert valid.all()
    np.testing.assert_array_equal(depth[0, -2:], [4, 4])


# --- fingerprint


def test_fingerprint_depends_on_content_and_names_only(tiny_sequence):
    reference = load_sequence(tiny_sequence).fingerprint()
    moved = tiny_sequence.with_name("elsewhere")
    shutil.copytree(tiny_sequence, moved)
    assert load_sequence(moved).fingerprint() == reference
    file = moved / "depth/000004.png"
    pixels = cv2.imread(str(file), cv2.IMREAD_UNCHANGED)
    pixels[20, 20] += 1
    write(file, pixels)
    changed = load_sequence(moved).fingerprint()
    assert changed != reference
    describe(moved, fx=51)
    assert load_sequence(moved).fingerprint() not in (reference, changed)


# --- truth


def test_truth_is_read_when_asked_for(tiny_sequence):
    truth = tiny_sequence / "truth"
    truth.mkdir()
    seq = load_sequence(tiny_sequence)
    assert (seq.truth.tissue(0), seq.truth.depth(0), seq.truth.tracks) == (None, None, None)
    (truth / "tissue").mkdir()
    (truth / "depth").mkdir()
    write(truth / "tissue/000002.png", np.full((40, 48, 3), (1, 2, 3), np.uint8))
    np.save(truth / "depth/000002.npy", np.full((40, 48), 61.5, np.float32))
    points, visible = np.random.default_rng(0).random((17, 5, 3)), np.ones((17, 5), bool)
    np.savez(truth / "tracks.npz", points=points, visible=visible)
    seq = load_sequence(tiny_sequence)
    assert (seq.truth.tissue(2) == (3, 2, 1)).all() and (seq.truth.depth(2) == 61.5).all()
    np.testing.assert_array_equal(seq.truth.tracks.points, points.astype(np.float32))
    assert seq.truth.tracks.visible.dtype == bool and seq.truth.tracks.region is None
    with pytest.raises(InputError, match=r"depth.*000003\.npy: expected"):
        seq.truth.depth(3)


@pytest.mark.parametrize(
    ("arrays", "words"),
    [
        ({"points": np.zeros((2, 4, 3))}, "expected arrays points and visible"),
        ({"points": np.zeros((3, 4, 3)), "visible": np.ones((3, 4))}, r"visible: numbers of shape \(2, any\)"),
        ({"points": np.zeros((2, 5, 3)), "visible": np.ones((2, 4))}, r"points: numbers of shape \(2, 4, 3\)"),
        ({"points": np.zeros((2, 4, 3)), "visible": np.ones(2)}, r"visible: numbers of shape \(2, any\), got \(2,\)"),
        ({"points": np.full((2, 4, 3), "a"), "visible": np.ones((2, 4))}, "points: numbers of shape .* of <U1"),
        ({"points": np.zeros((2, 4, 3)), "visible": np.ones((2, 4)), "paired": [1, 0]}, "paired: numbers of shape"),
        ({"points": np.array([None])}, "a NumPy file"),
        ({"points": np.zeros((2, 4, 3)), "visible": np.ones((2, 4)), "region": ["smooth"] * 3}, "region of shape"),
    ],
)
def test_wrong_tracks_are_rejected(tmp_path, arrays, words):
    np.savez(tmp_path / "tracks.npz", **arrays)
    with pytest.raises(InputError, match=words) as caught:
        _ = Truth(tmp_path, ["0", "1"]).tracks
    assert "\n" not in str(caught.value)


@pytest.mark.parametrize("part", ["depth", "seen"])
@pytest.mark.parametrize("array", [{"a": np.zeros((2, 2))}, np.full((2, 2), "far"), np.zeros(2)])
def test_wrong_maps_of_the_truth_are_rejected(tmp_path, part, array):
    (tmp_path / part).mkdir()
    with (tmp_path / part / "0.npy").open("wb") as file:
        np.savez(file, **array) if isinstance(array, dict) else np.save(file, array)
    with pytest.raises(InputError, match=rf"{part}/0\.npy: expected numbers of shape \(any, any\), got "):
        getattr(Truth(tmp_path, ["0"]), part)(0)


# --- remarks: usable, but suspicious


def test_remarks(tiny_sequence):
    for file in (tiny_sequence / "masks").iterdir():
        mask = np.full((40, 48), 255, np.uint8)
        mask[:, :10] = 0
        write(file, mask)
    write(tiny_sequence / "depth/000003.png", np.zeros((40, 48), np.uint16))
    for i in range(17):  # counted from 1, and so not in the way of each other
        (tiny_sequence / f"depth/{i:06d}.png").rename(tiny_sequence / f"depth/d{i + 1}.png")
    describe(tiny_sequence, fx=None)
    change_poses(tiny_sequence, lambda p: np.where(np.isin(np.arange(17), (4, 9)), 2 * p, p))
    remarks = load_sequence(tiny_sequence).validate()
    for part in (
        "counted otherwise: d1.png for image 000000",
        "79% of all pixels are masked",
        "1 frames have no depth",
        "for 96x80 px",
    ):
        assert sum(part in remark for remark in remarks) == 1
    assert len(remarks) == 4 and not any("\n" in remark for remark in remarks)


@pytest.mark.parametrize("times", [2, 0.25])
def test_focal_length_of_another_size_is_scaled(tiny_sequence, times):
    describe(tiny_sequence, fx=None, fy=None)
    before = load_sequence(tiny_sequence).camera(0)
    change_poses(tiny_sequence, lambda p: np.where(np.isin(np.arange(17), (4, 9)), times * p, p))
    after = load_sequence(tiny_sequence).camera(0)
    assert (after.fx, after.fy) == pytest.approx((before.fx / times, before.fx / times))
    assert (after.cx, after.cy) == (before.cx, before.cy) == (24, 20)


@pytest.mark.parametrize("stored", [(512, 48), (0, 0), (-40, -48)])
def test_a_stored_size_of_another_shape_is_rejected(tiny_sequence, stored):
    describe(tiny_sequence, fx=None)
    height, width = stored
    row = np.arange(17)
    change_poses(tiny_sequence, lambda p: np.where(row == 4, height, np.where(row == 9, width, p)))
    with pytest.raises(InputError, match=rf"48x40 px, or that shape, got {width}x{height}"):
        load_sequence(tiny_sequence)


def test_real_clip(real_clip):
    seq = load_sequence(real_clip)
    assert len(seq) == 90 and len(seq.frames("train")) == 78 and seq.frames_per_second == 15
    frame = seq.frame(1)
    assert frame.rgb_u8.shape == (512, 640, 3) and frame.camera.fx == 586.5
    assert 40 < np.median(frame.depth[frame.depth_valid & frame.tissue_mask]) < 200
    assert 0.05 < (~frame.tissue_mask).mean() < 0.3
