"""STIR: clips are sent to prepare; tattooed points become unpaired truth of the prepared folder."""

from __future__ import annotations

import json
import shlex

import cv2
import numpy as np
import pytest
from known_surface import NORMAL, OFFSET, seen_through_lens, turned
from reader_checks import assert_rejected
from sequence_edits import write
from video_files import write_video

from endoprior.cli import main
from endoprior.core.checks import InputError
from endoprior.data import load_sequence, write_stir_tracks
from endoprior.data.description import PrepareRecord
from endoprior.data.stir import nearest_end_errors, stir_tracks, tattoo_centers

SCALE = 2
"""The prepared clip is half as large as the segmentation."""
SIZE = (320, 256)


def spots(*boxes):
    """96 x 80 px image with boxes (x, y, w, h) marked."""
    image = np.zeros((80, 96, 3), np.uint8)
    for x, y, w, h in boxes:
        image[y : y + h, x : x + w] = 255
    return image


@pytest.fixture
def clip(tmp_path):
    folder = tmp_path / "7" / "left" / "seq00"
    (folder / "segmentation").mkdir(parents=True)
    (folder / "frames").mkdir()
    (folder / "frames/00000ms-01000ms-visible.mp4").write_bytes(b"")
    write(folder / "segmentation/icgstartseg.png", spots((40, 30, 4, 4), (60, 60, 6, 2), (0, 0, 2, 2)))
    write(folder / "segmentation/icgendseg.png", spots((44, 30, 4, 4)))
    return folder


@pytest.fixture
def prepared(tiny_sequence):
    """The tiny sequence as `prepare` leaves it if nothing is rectified."""
    corners = (((0.0, 0.0), (96.0, 0.0)), ((0.0, 80.0), (96.0, 80.0)))
    PrepareRecord("/v.mp4", {}, (96, 80), corners).save(tiny_sequence)
    return tiny_sequence


def test_clip_is_sent_to_prepare(clip):
    video = clip / "frames/00000ms-01000ms-visible.mp4"
    right = clip.parents[1] / "right/seq00"
    words = f"`endoprior prepare {video} OUT --border keep --stir {clip}`; without {right} its"
    assert_rejected(clip, "seq00", words)
    assert_rejected(clip.parents[1], "7", words)
    (right / "frames").mkdir(parents=True)
    assert_rejected(clip, "seq00", "calib.json its depth has no unit")
    (clip.parents[1] / "calib.json").write_text("{}")
    options = f"--right {right / 'frames/VIDEO.mp4'} --calibration {clip.parents[1] / 'calib.json'} --border keep"
    assert_rejected(clip.parents[1], "7", f"`endoprior prepare {video} OUT {options} --stir {clip}` (docs")


def raw_recording(folder, spot_px):
    """A recording in the layout of STIRLoader: two cameras with distortion that squint at the plane, T in m.

    Returns the clip, and where the rectified left camera sees the spots, px with centers at halves, and their depth.
    """
    left, bent = np.array([[300.0, 0, 165], [0, 302, 120], [0, 0, 1]]), np.array([-0.15, 0.04, 0.001, -0.002, 0])
    right = np.array([[298.0, 0, 150], [0, 299, 131], [0, 0, 1]])
    turn, shift = turned(0.5, -1.5, 0.6), np.array([-4.2, 0.06, -0.1])
    names = ("leftcameramat", "leftdistortioncoeffs", "rightcameramat", "rightdistortioncoeffs")
    values = (left, bent, right, -0.5 * bent)
    stored = dict(zip(names, (value.tolist() for value in values), strict=True))
    stored |= {"rotation": turn.tolist(), "translation": (shift / 1000).tolist()}
    folder.mkdir()
    (folder / "calib.json").write_text(json.dumps(stored))
    right_to_world = np.linalg.inv(np.vstack([np.column_stack([turn, shift]), (0, 0, 0, 1)]))
    for side, matrix, lens, axes in (("left", left, bent, np.eye(4)), ("right", right, -0.5 * bent, right_to_world)):
        clip = folder / side / "seq00"
        (clip / "frames").mkdir(parents=True)
        (clip / "segmentation").mkdir()
        color, _ = seen_through_lens(matrix, lens, axes, SIZE)
        write_video(clip / "frames/00000ms-00120ms-visible.mp4", [color] * 3)
        marked = np.zeros((SIZE[1], SIZE[0], 3), np.uint8)
        for x, y in spot_px:
            marked[y - 2 : y + 3, x - 2 : x + 3] = 255
        for name in ("icgstartseg", "icgendseg"):
            write(clip / f"segmentation/{name}.png", marked)
    r1, _, p1 = cv2.stereoRectify(
        left, bent, right, -0.5 * bent, SIZE, turn, shift[:, None], flags=cv2.CALIB_ZERO_DISPARITY, alpha=0
    )[:3]
    at = np.array(spot_px, np.float64)[:, None]
    places = cv2.undistortPoints(at, left, bent, None, r1, p1, (3, 100, 1e-12))[:, 0] + 0.5
    rays = np.column_stack([cv2.undistortPoints(at, left, bent, criteria=(3, 100, 1e-12))[:, 0], np.ones(len(at))])
    points = rays * (OFFSET / (rays @ NORMAL))[:, None]
    return folder / "left/seq00", places, (points @ r1.T)[:, 2]


def test_spots_of_raw_images_land_where_the_rectified_frames_show_them(tmp_path):
    """The printed command, as it is: stereo by calib.json, and spots through the rectification."""
    spot_px = [(60, 50), (250, 60), (160, 128), (70, 200), (260, 210), (3, 3)]  # the last is beyond the frame
    clip, places, depth = raw_recording(tmp_path / "7", spot_px)
    with pytest.raises(InputError) as caught:
        load_sequence(clip)
    words = shlex.split(str(caught.value).split("`")[1])
    words[words.index("OUT")] = str(tmp_path / "out")
    assert main([*words[1:], "--masks", "none", "--poses", "still"]) == 0
    seq = load_sequence(tmp_path / "out")
    camera, tracks = seq.camera(0), seq.truth.tracks
    shown = ((places > 0) & (places < SIZE)).all(1)
    assert shown.tolist() == [True] * 5 + [False] and np.abs(places - spot_px)[shown].max() > 5
    found = tracks.points[0, tracks.visible[0]]
    px = found[:, :2] / found[:, 2:] * (camera.fx, camera.fy) + (camera.cx, camera.cy)
    near = np.linalg.norm(px[:, None] - places[None, shown], axis=-1).argmin(0)
    assert sorted(near.tolist()) == [0, 1, 2, 3, 4]
    np.testing.assert_allclose(px[near], places[shown], atol=0.1)  # the record is rounded to 0.01 px
    np.testing.assert_allclose(found[near, 2], depth[shown], rtol=0.03)  # stereo matching
    np.testing.assert_array_equal(tracks.visible[-1].sum(), 5)


def test_centers_are_those_of_the_bounding_boxes(clip):
    centers = tattoo_centers(clip / "segmentation/icgstartseg.png")
    np.testing.assert_array_equal(centers[np.argsort(centers[:, 0])], [[1, 1], [42, 32], [63, 61]])
    write(clip / "segmentation/icgendseg.png", spots())
    assert tattoo_centers(clip / "segmentation/icgendseg.png").shape == (0, 2)


def test_tracks_are_unpaired_and_lifted(clip, prepared):
    tiny_sequence = prepared
    out = write_stir_tracks(clip, tiny_sequence)
    assert out == tiny_sequence / "truth/tracks.npz"
    seq = load_sequence(tiny_sequence)
    tracks = seq.truth.tracks
    assert tracks.points.shape == (17, 3, 3)  # the spot where depth is missing is left out
    np.testing.assert_array_equal(tracks.visible.sum(1), [2, *[0] * 15, 1])
    assert (tracks.visible.sum(0) == 1).all()
    camera, start = seq.camera(0), seq.frame(0)
    at = tracks.points[0, tracks.visible[0]]
    pixels = at[:, :2] / at[:, 2:] * (camera.fx, camera.fy) + (camera.cx, camera.cy)
    pixels, at = pixels[np.argsort(pixels[:, 0])], at[np.argsort(pixels[:, 0])]
    np.testing.assert_allclose(pixels, np.array([[42, 32], [63, 61]]) / SCALE, atol=1e-4)  # float32 points
    assert at[0, 2] == pytest.approx(np.median(start.depth[14:19, 19:24]))
    end = tracks.points[-1, tracks.visible[-1]]
    np.testing.assert_allclose(end[0, :2] / end[0, 2] * 50 + (24, 20), np.array([46, 32]) / SCALE, atol=1e-4)
    with np.load(out) as stored:
        assert not stored["paired"]


def test_lift_of_hand_made_points(tiny_sequence):
    frame = load_sequence(tiny_sequence).frame(0)
    tracks = stir_tracks(np.array([[24.0, 20]]), np.zeros((0, 2)), frame, frame, 3)
    np.testing.assert_allclose(tracks.points[0, 0, :2], 0, atol=1e-6)  # the principal point lies on the axis
    assert tracks.visible.tolist() == [[True], [False], [False]]


def test_errors_go_to_the_nearest_end():
    predicted, ends = np.array([[0.0, 0, 0], [10, 0, 0], [4, 3, 0]]), np.array([[0.0, 0, 1], [10, 2, 0]])
    np.testing.assert_allclose(nearest_end_errors(predicted, ends), [1, 2, np.sqrt(26)])


def test_spots_follow_a_crop(clip, make_tiny_sequence):
    cropped = make_tiny_sequence("cropped", height=30)
    corners = (((0.0, 20.0), (96.0, 20.0)), ((0.0, 80.0), (96.0, 80.0)))
    PrepareRecord("/v.mp4", {}, (96, 80), corners).save(cropped)
    write_stir_tracks(clip, cropped)
    seq = load_sequence(cropped)
    at = seq.truth.tracks.points[0, seq.truth.tracks.visible[0]]
    y = np.sort(at[:, 1] / at[:, 2] * 50 + 15)
    np.testing.assert_allclose(y, np.array([32 - 20, 61 - 20]) / SCALE, atol=1e-4)


def test_folders_without_their_record_are_rejected(clip, tiny_sequence):
    with pytest.raises(InputError, match=r"prepare\.json: expected the record of `prepare`.*got no such file\."):
        write_stir_tracks(clip, tiny_sequence)
    corners = (((0.0, 0.0), (96.0, 0.0)), ((0.0, 54.0), (96.0, 54.0)))
    PrepareRecord("/v.mp4", {}, (96, 54), corners).save(tiny_sequence)
    with pytest.raises(InputError, match=r"icgstartseg\.png: expected the shape of the video, 96x54 px, got 96x80\."):
        write_stir_tracks(clip, tiny_sequence)


@pytest.mark.parametrize("option", ["--start 1", "--end 2", "--drop-out-of-body"])
def test_spots_belong_to_the_first_and_the_last_frame(clip, tmp_path, capsys, option):
    video = next((clip / "frames").iterdir())
    assert main(["prepare", str(video), str(tmp_path / "out"), "--stir", str(clip), *option.split()]) == 2
    assert f"--stir: expected all frames of the clip, got {option.split()[0]}. Fix:" in capsys.readouterr().err


def test_clips_without_points_are_rejected(clip, prepared):
    tiny_sequence = prepared
    write(clip / "segmentation/icgendseg.png", spots())
    with pytest.raises(InputError, match=r"icgendseg\.png: expected spots where the frame has depth, got none of 0"):
        write_stir_tracks(clip, tiny_sequence)
    (clip / "segmentation/icgendseg.png").unlink()
    with pytest.raises(InputError, match=r"icgendseg\.png: expected a readable file"):
        write_stir_tracks(clip, tiny_sequence)
    assert not (tiny_sequence / "truth").exists()
