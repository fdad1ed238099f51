"""The right camera: which folders have one, what both cameras see by depth, and how a scene is scored from there."""

import json
from dataclasses import replace
from types import SimpleNamespace

import cv2
import numpy as np
import pytest
import torch
from tiny_training import losses_of, tiny_config

from endoprior.cli import main
from endoprior.core.checks import InputError
from endoprior.core.config import DataConfig
from endoprior.core.geometry import back_project, project, right_camera
from endoprior.core.types import Camera, RenderedView
from endoprior.data import load_sequence
from endoprior.data.right_camera import NEAREST, measured_disparity, right_disparity, warp_to_right
from endoprior.evaluation.context import NO_SCENE, Evaluation, EvaluationContext, SceneFrames
from endoprior.evaluation.scorers import other_views
from endoprior.phantom import PhantomConfig, write_phantom

BASELINE = 4.0


@pytest.fixture
def pair(tiny_sequence):
    """The tiny sequence with right pictures of one color each, 10 times the number of the frame, and a baseline."""
    (tiny_sequence / "right").mkdir()
    for index in range(17):
        write_right(tiny_sequence, f"{index:06d}.png", 10 * index)
    describe(tiny_sequence, baseline_mm=BASELINE)
    return tiny_sequence


def write_right(folder, name, value, size=(48, 40)):
    picture = np.full((size[1], size[0], 3), value, np.uint8)
    picture[:, 1::2] += 4
    assert cv2.imwrite(str(folder / "right" / name), picture)


def describe(folder, **facts):
    path = folder / "sequence.json"
    path.write_text(json.dumps((json.loads(path.read_text()) if path.exists() else {}) | facts))


# --- reading ----------------------------------------------------------------------------------------------------------


def test_a_folder_with_right_pictures_and_a_baseline_has_a_right_eye(pair):
    sequence = load_sequence(pair)
    eye = sequence.right_eye
    assert eye.baseline_mm == BASELINE and sequence.remarks == []
    assert eye.image(3).shape == (40, 48, 3) and (eye.image(3)[0, :2] == [[30] * 3, [34] * 3]).all()
    assert sequence.training_view().right_eye is None and sequence.right_eye is eye


def test_right_pictures_follow_the_frames_that_are_read(pair):
    cfg = DataConfig(stride=2, first_frames=6, skip_frames="0,2", shrink=2)
    sequence = load_sequence(pair, cfg)  # frames 2, 6, 8 and 10 of the folder
    pictures = [sequence.right_eye.image(i) for i in range(len(sequence))]
    assert [int(picture[0, 0, 0]) for picture in pictures] == [22, 62, 82, 102]  # mean of two columns
    assert all(picture.shape == sequence.frame(0).rgb_u8.shape for picture in pictures)


def test_a_plain_folder_has_a_right_eye_where_its_depth_has_a_unit(pair):
    cfg = DataConfig(format="plain", depth_unit_mm=0.01)
    assert load_sequence(pair, cfg).right_eye.baseline_mm == BASELINE
    describe(pair, depth_scale=None)
    relative = load_sequence(pair, DataConfig(format="plain"))
    assert relative.right_eye is None and any("scale of the depth is unknown" in line for line in relative.remarks)


@pytest.mark.parametrize(
    ("facts", "reason"),
    [
        ({"baseline_mm": None}, "has no baseline_mm"),
        ({"baseline_mm": 0}, "baseline_mm in sequence.json is 0"),
        ({"baseline_mm": "4 mm"}, "baseline_mm in sequence.json is '4 mm'"),
        ({"baseline_mm": True}, "baseline_mm in sequence.json is True"),
        ({"depth_relative": True}, "the scale of the depth is unknown"),
    ],
)
def test_a_description_that_does_not_fit_is_a_remark(pair, facts, reason):
    describe(pair, **facts)
    sequence = load_sequence(pair)
    assert sequence.right_eye is None
    assert [line for line in sequence.remarks if line.startswith(f"{pair / 'right'}: ignored") and reason in line]


def test_pictures_that_do_not_fit_are_a_remark(pair):
    write_right(pair, "000000.png", 0, (32, 40))
    assert "first image has 32x40 px, and the left one 48x40 px" in load_sequence(pair).remarks[0]
    (pair / "right/000000.png").unlink()
    sequence = load_sequence(pair)
    assert sequence.right_eye is None and "it has 16 images, not one of" in sequence.remarks[0]
    write_right(pair, "000017.png", 0)  # one too late
    sequence = load_sequence(pair)
    assert sequence.right_eye is not None and "counted otherwise: 000001.png for image 000000" in sequence.remarks[0]


def test_a_broken_picture_is_named_when_it_is_used(pair):
    (pair / "right/000009.png").write_bytes(b"not an image")
    eye = load_sequence(pair).right_eye
    with pytest.raises(InputError, match=r"right/000009\.png: expected"):
        eye.image(9)


def test_right_pictures_belong_to_the_fingerprint_and_other_folders_keep_theirs(make_tiny_sequence):
    folder = make_tiny_sequence()
    without = load_sequence(folder).fingerprint()
    (folder / "right").mkdir()
    for index in range(17):
        write_right(folder, f"{index:06d}.png", index)
    assert load_sequence(folder).fingerprint() == without  # ignored: no baseline
    describe(folder, baseline_mm=BASELINE)
    with_right = load_sequence(folder)
    before = with_right.fingerprint()
    write_right(folder, "000004.png", 99)
    assert with_right.fingerprint() != before


# --- geometry ---------------------------------------------------------------------------------------------------------


def noise(height, width, seed=0):
    return np.random.default_rng(seed).random((height, width, 3)).astype(np.float32)


def test_the_right_camera_stands_beside_the_left_one():
    turn = cv2.Rodrigues(np.array([0.2, -0.3, 0.1]))[0]
    pose = np.block([[turn, np.array([[5.0], [-2.0], [9.0]])], [np.zeros((1, 3)), np.ones((1, 1))]])
    left = Camera(64, 48, 50, 55, 30, 25, pose)
    right = right_camera(left, BASELINE)
    assert np.allclose(right.center - left.center, BASELINE * turn[0])  # row 0: its x axis in the world
    point = back_project(np.array([20.0, 30.0]), np.array(40.0), left)
    pixel, z = project(point, right)
    assert np.allclose(pixel, [20 - 50 * BASELINE / 40, 30]) and np.isclose(z, 40)


def test_a_plane_with_a_whole_disparity_is_moved_exactly():
    rgb = noise(12, 30)
    moved, counted = warp_to_right(rgb, np.full((12, 30), 5.0), np.ones((12, 30), bool))
    inside = np.zeros((12, 30), bool)
    inside[1:-1, 1:24] = True  # the last 5 columns show what the left eye does not; 1 px is eroded
    assert (counted == inside).all() and moved.dtype == np.float32
    assert (moved[inside] == np.roll(rgb, -5, 1)[inside]).all() and not moved[~inside].any()


def test_a_slanted_plane_is_joined_and_read_between_pixels():
    center = np.arange(40) + 0.5
    disparity = np.tile(3 + 0.2 * center, (3, 1))  # right column 0.8 left - 3: narrower in the right eye
    exact = np.where(center < 0.8 * center[-1] - 3, 3 + 0.2 * (center + 3) / 0.8, 0)
    found = right_disparity(disparity, np.ones((3, 40), bool))
    last = int(0.8 * center[-1] - 3)  # the last point is joined to one side only, and covers its pixel as it is
    assert np.allclose(found[:, :last], exact[:last]) and np.allclose(found[:, last], disparity[:, -1]) and last == 28
    assert not found[:, last + 1 :].any()
    stretched = np.tile(10 - 0.6 * center[:15], (3, 1))  # right column 1.6 left - 10: wider, without gaps
    found = right_disparity(stretched, np.ones((3, 15), bool))
    last = int(1.6 * center[14] - 10)
    assert np.allclose(found[:, :last], (10 - 0.6 * (center[:15] + 10) / 1.6)[:last]) and last == 13


def test_a_box_hides_what_is_behind_and_what_the_left_eye_misses_does_not_count():
    disparity, tissue = np.full((20, 60), 4.0), np.ones((20, 60), bool)
    disparity[5:15, 30:40], tissue[5:15, 30:40] = 10.0, False
    seen = right_disparity(disparity, tissue)
    expected = np.zeros((20, 60))
    expected[:, :56] = 4.0
    expected[5:15, 20:30] = 0  # the box
    expected[5:15, 30:36] = 0  # beside it: the left eye sees the box there
    assert (seen == expected).all()
    tissue[5:15, 30:40] = True  # now it is tissue, and is seen itself
    expected[5:15, 20:30] = 10.0
    assert (right_disparity(disparity, tissue) == expected).all()


def test_a_tool_without_depth_hides_all_that_it_may_hide():
    disparity, tissue = np.full((3, 60), 4.0), np.ones((3, 60), bool)
    disparity[1, 30], tissue[1, 30] = 0, False
    expected = np.zeros((3, 60))
    expected[:, :56] = 4.0
    expected[1, 30 - int(4 / NEAREST) : 30 - 4 + 1] = 0
    assert (right_disparity(disparity, tissue) == expected).all()
    tissue[2, -1] = False  # it goes on beyond the border: left columns 60, 61, ... are at 60 - 8 and so on
    expected[2, 52:] = 0
    assert (right_disparity(disparity, tissue) == expected).all()


def slow_disparity(disparity, tissue):
    """One row after the other, one pixel after the other; no tools without depth."""
    height, width = disparity.shape
    out = np.zeros((height, width))
    for row in range(height):
        near = disparity[row]
        for column in range(width):
            center, found = column + 0.5, [(0.0, False)]
            for i in range(width):
                if near[i] <= 0:
                    continue
                at = i + 0.5 - near[i]
                neighbors = [j for j in (i - 1, i + 1) if 0 <= j < width and near[j] > 0]
                joined = [j for j in neighbors if abs(near[j] - near[i]) < 1]
                if len(joined) < 2 and int(np.floor(at)) == column:
                    found.append((near[i], bool(tissue[row, i])))
                if i + 1 in joined and at <= center <= (end := i + 1.5 - near[i + 1]):
                    share = (center - at) / (end - at)
                    value = near[i] * (1 - share) + near[i + 1] * share
                    found.append((value, bool(tissue[row, i] and tissue[row, i + 1])))
            nearest = max(value for value, _ in found)
            if all(is_tissue for value, is_tissue in found if value == nearest):
                out[row, column] = nearest
    return out


def test_any_depth_agrees_with_a_slow_loop():
    rng = np.random.default_rng(4)
    disparity = 8 + cv2.GaussianBlur(rng.standard_normal((30, 50)) * 12, (0, 0), 2)
    disparity[10:20, 20:28] += 6
    tissue = np.ones((30, 50), bool)
    tissue[12:18, 22:26] = False
    disparity[rng.random((30, 50)) < 0.05] = 0
    disparity[12:18, 22:26] = 15.3  # measured on all of the tool
    assert np.allclose(right_disparity(disparity, tissue), slow_disparity(disparity, tissue))
    assert not right_disparity(np.zeros((5, 6)), np.ones((5, 6), bool)).any()


# --- scores -----------------------------------------------------------------------------------------------------------


@pytest.fixture(scope="module")
def stereo(tmp_path_factory):
    """A phantom with right pictures, whose frame 1 is a test frame."""
    out = tmp_path_factory.mktemp("phantom") / "sequence"
    write_phantom(out, PhantomConfig(frames=3, width=160, height=128, stereo=True, side_views=False))
    return out


def scored(sequence, render=None):
    """Scores, reasons, and the rows of frames. `render`: of a scene; None for rendered images only."""
    result = Evaluation({"split": "test"}, per_frame=[{"index": i} for i in sequence.indices("test")])
    reconstruction = SceneFrames(SimpleNamespace(render=render), sequence) if render else SimpleNamespace()
    other_views.score_right_eye(EvaluationContext(reconstruction, sequence, "test", False, None, result))
    return result


def test_the_right_picture_itself_is_perfect_and_the_left_one_is_not(stereo):
    sequence = load_sequence(stereo)
    asked = []

    def view(picture):
        return RenderedView(torch.from_numpy(picture), torch.ones(picture.shape[:2]), torch.ones(picture.shape[:2]))

    def perfect(time, camera):
        asked.append((time, camera.center))
        return view(np.clip(sequence.right_eye.image(1) + np.float32(0.5), 0, 255) / 255)

    result = scored(sequence, perfect)
    assert result.scores["right_psnr"] > 50 and 30 < result.scores["right_psnr_warp"] < 45
    assert result.per_frame[0]["right_psnr"] == result.scores["right_psnr"]
    assert [time for time, _ in asked] == [1 / 3] and np.allclose(asked[0][1], [4.2, 0, 0])
    assert "right_lpips" in result.skipped
    left = scored(sequence, lambda time, camera: view(sequence.frame(1).rgb))
    assert left.scores["right_psnr"] < 25 and left.scores["right_psnr_warp"] == result.scores["right_psnr_warp"]


def test_the_perceptual_distance_is_of_the_same_pixels(stereo, monkeypatch):
    sequence, asked = load_sequence(stereo), []
    monkeypatch.setattr(other_views, "squeeze_distance", lambda context, name: lambda *args: asked.append(args) or 0.25)
    gray = torch.full((128, 160, 3), 0.5)
    result = scored(sequence, lambda time, camera: RenderedView(gray, gray[..., 0], gray[..., 0]))
    ((view, true, counted),) = asked
    assert result.scores["right_lpips"] == result.per_frame[0]["right_lpips"] == 0.25
    assert (view == 0.5).all() and np.allclose(true * 255, sequence.right_eye.image(1)) and counted.dtype == bool


def test_what_counts_is_what_both_eyes_truly_see(stereo):
    """The warp of the tool-free truth by exact depth is the right picture, but for noise and moving highlights."""
    sequence = load_sequence(stereo)
    frame, eye = sequence.frame(1), sequence.right_eye
    measured = measured_disparity(frame, eye.baseline_mm)
    warped, counted = warp_to_right(frame.rgb, measured, frame.tissue_mask)
    error = np.abs(warped - eye.image(1) / np.float32(255)).max(-1)
    assert 0.4 < counted.mean() < frame.tissue_mask.mean() and np.quantile(error[counted], 0.99) < 0.15


def test_clipped_depth_does_not_count(pair):
    frame = load_sequence(pair).frame(1)
    found = measured_disparity(frame, BASELINE)
    clipped = np.isin(frame.depth, [frame.depth[frame.depth > 0].min(), frame.depth.max()]) | ~frame.depth_valid
    assert 20 < clipped.sum() < 0.1 * clipped.size and ((found == 0) == clipped).all()
    assert np.allclose(found[~clipped], frame.camera.fx * BASELINE / frame.depth[~clipped])


def test_rendered_images_have_the_warp_only_and_other_sequences_nothing(stereo):
    result = scored(load_sequence(stereo))
    assert set(result.scores) == {"right_psnr_warp"}
    assert result.skipped == {"right_psnr": NO_SCENE, "right_lpips": NO_SCENE}
    result = scored(load_sequence(stereo).training_view())
    assert result.scores == {} and result.skipped == {}


def test_a_frame_without_tissue_has_a_reason(pair):
    for mask in (pair / "masks").glob("*.png"):
        assert cv2.imwrite(str(mask), np.full((40, 48), 255, np.uint8))
    result = scored(load_sequence(pair))
    assert result.scores == {} and result.skipped["right_psnr_warp"] == other_views.NO_RIGHT


# --- training ---------------------------------------------------------------------------------------------------------


def test_the_right_frame_has_the_depth_of_the_left_one(pair):
    sequence = load_sequence(pair)
    left, right = sequence.frame(3), sequence.right_frame(3)
    assert (right.rgb_u8 == sequence.right_eye.image(3)).all() and right.time == left.time
    assert np.allclose(right.camera.center - left.camera.center, [BASELINE, 0, 0])
    assert right.tissue_mask.any() and (right.depth_valid == right.tissue_mask).all()
    y, x = (index[len(index) // 2] for index in np.nonzero(right.tissue_mask))
    point = back_project(np.array([x + 0.5, y + 0.5]), right.depth[y, x], right.camera)
    (u, v), z = project(point, left.camera)
    assert abs(left.depth[int(v), int(u)] - z) < 0.05 * z  # the surface is not flat


def test_both_eyes_are_trained_on_in_turn_and_equal_runs_are_equal(pair):
    left = tiny_config("basis")
    both = replace(left, data=replace(left.data, eyes="both"))
    first, second, without = losses_of(pair, both), losses_of(pair, both), losses_of(pair, left)
    assert first == second and first != without


def test_both_eyes_need_a_right_one(tiny_sequence, tmp_path, capsys):
    assert main(["train", str(tiny_sequence), str(tmp_path / "run"), "--eyes", "both"]) == 2
    error = capsys.readouterr().err
    assert "expected right/ and baseline_mm for --eyes both, got no right eye" in error and error.count("\n") == 1
    assert not (tmp_path / "run").exists()
