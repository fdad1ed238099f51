"""STIR: clips are sent to prepare; tattooed points become unpaired truth of the prepared folder."""

from __future__ import annotations

import numpy as np
import pytest
from reader_checks import assert_rejected
from sequence_edits import write

from endoprior.core.checks import InputError
from endoprior.data import load_sequence, write_stir_tracks
from endoprior.data.stir import nearest_end_errors, stir_tracks, tattoo_centers

SCALE = 2
"""The prepared clip is half as large as the segmentation."""


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


def test_clip_is_sent_to_prepare(clip):
    video = clip / "frames/00000ms-01000ms-visible.mp4"
    words = f"`endoprior prepare {video} OUT --border keep --stir {clip}`"
    assert_rejected(clip, "seq00", words)
    assert_rejected(clip.parents[1], "7", words)


def test_centers_are_those_of_the_bounding_boxes(clip):
    centers = tattoo_centers(clip / "segmentation/icgstartseg.png")
    np.testing.assert_array_equal(centers[np.argsort(centers[:, 0])], [[1, 1], [42, 32], [63, 61]])
    write(clip / "segmentation/icgendseg.png", spots())
    assert tattoo_centers(clip / "segmentation/icgendseg.png").shape == (0, 2)


def test_tracks_are_unpaired_and_lifted(clip, tiny_sequence):
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


def test_a_cropped_folder_is_rejected(clip, make_tiny_sequence):
    with pytest.raises(InputError, match=r"whole image of .*icgstartseg\.png, got 48x30 px for 96x80\. Fix: Prepare"):
        write_stir_tracks(clip, make_tiny_sequence("cropped", height=30))


def test_clips_without_points_are_rejected(clip, tiny_sequence):
    write(clip / "segmentation/icgendseg.png", spots())
    with pytest.raises(InputError, match=r"icgendseg\.png: expected spots where the frame has depth, got none of 0"):
        write_stir_tracks(clip, tiny_sequence)
    (clip / "segmentation/icgendseg.png").unlink()
    with pytest.raises(InputError, match=r"icgendseg\.png: expected a readable file"):
        write_stir_tracks(clip, tiny_sequence)
    assert not (tiny_sequence / "truth").exists()
