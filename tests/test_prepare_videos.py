"""From particular videos to sequence folders: every frame that is not used is counted, and `check` repeats it."""

from __future__ import annotations

import json
import shlex
from fractions import Fraction

import cv2
import numpy as np
import pytest
from video_files import encode, ffmpeg, psnr, smooth, write_video

from endoprior.check.facts import measure
from endoprior.check.findings import find
from endoprior.core.checks import InputError
from endoprior.data import load_sequence
from endoprior.data.description import read_record
from endoprior.data.images import read_color
from endoprior.prepare import PrepareConfig, prepare
from endoprior.prepare.video import SourceFrame
from endoprior.prepare.video_clip import pair_by_time


def prepared(video, tmp_path, **options):
    """`prepare` without masks, depth and poses: (result, notes about the video, sequence.json)."""
    chosen = {"masks": "none", "depth": "none", "poses": "still", "border": "keep"} | options
    done = prepare(video, tmp_path / "out", PrepareConfig(**chosen))
    return done, read_record(done.out).video_notes, json.loads((done.out / "sequence.json").read_text())


def images_of(folder):
    return [read_color(file) for file in sorted(folder.glob("*.png"))]


def calibration(tmp_path, fx, fy, center, size):
    file, (cx, cy) = tmp_path / "c.json", center
    file.write_text(json.dumps({"K": [[fx, 0, cx], [0, fy, cy], [0, 0, 1]], "pixel_center": 0.5} | size))
    return file


def stereo_calibration(tmp_path):
    k, file = [[100, 0, 48], [0, 100, 32], [0, 0, 1]], tmp_path / "c.json"
    file.write_text(json.dumps({"K_left": k, "K_right": k, "R": np.eye(3).tolist(), "T_mm": [-4.2, 0, 0]}))
    return file


@pytest.mark.parametrize("size", [{"width": 128, "height": 64}, {"width": 96, "height": 64}, {}])
@pytest.mark.parametrize("of_stored_pixels", [False, True])
def test_a_calibration_of_either_kind_of_pixels_fits(tmp_path, size, of_stored_pixels):
    if size and (size["width"] == 96) != of_stored_pixels:
        pytest.skip("a size that contradicts the focal lengths")
    video = encode(tmp_path / "a.mp4", smooth(12), sample_aspect_ratio=Fraction(4, 3))
    width, fx = (96, 75.0) if of_stored_pixels else (128, 100.0)
    file = calibration(tmp_path, fx, 100.0, (width / 2, 32), size)
    _, notes, described = prepared(video, tmp_path, calibration=file)
    assert [described[key] for key in ("width", "height", "fx", "fy", "cx", "cy")] == [128, 64, 100, 100, 64, 32]
    assert any("the calibration belongs to the stored pixels" in note for note in notes) == of_stored_pixels


@pytest.mark.parametrize("turned", [False, True])
def test_masks_and_depth_of_stored_pixels_are_stretched_with_them(tmp_path, turned):
    video = encode(tmp_path / "a.mp4", smooth(6), sample_aspect_ratio=Fraction(4, 3))
    if turned:
        video = ffmpeg("-display_rotation", "90", "-i", video, "-c", "copy", tmp_path / "t.mp4")
    for folder in ("m", "d"):
        (tmp_path / folder).mkdir()
    for i in range(6):
        values = np.zeros((96, 64) if turned else (64, 96), np.uint8)
        values[6 : 6 + 30, 12 : 12 + 24] = 255
        cv2.imwrite(str(tmp_path / f"m/{i}.png"), values)
        np.save(tmp_path / f"d/{i}.npy", np.where(values > 0, np.float32(70), np.float32(90)))
    done, _, _ = prepared(video, tmp_path, masks=str(tmp_path / "m"), depth=str(tmp_path / "d"), depth_unit_mm=1.0)
    want = np.s_[8:48, 12:36] if turned else np.s_[6:36, 16:48]  # 3 px become 4
    mask, depth = (cv2.imread(str(done.out / part / "000000.png"), -1) for part in ("masks", "depth"))
    assert done.size == ((64, 128) if turned else (128, 64))
    assert (mask[want] == 255).all() and (mask > 0).sum() == mask[want].size
    assert (depth[want] == 7000).all() and (depth == 7000).sum() == mask[want].size


def test_a_pause_leaves_no_frame_out(tmp_path):
    images = smooth(24)
    times = [*range(12), *range(250, 262)]
    done, notes, described = prepared(encode(tmp_path / "p.mp4", images, times=times), tmp_path)
    assert done.num_frames == 24 and described["frames_per_second"] == pytest.approx(25)
    assert "238 steps of the time grid have no frame and are left out" in notes


def test_images_between_the_steps_are_counted(tmp_path):
    times = [*range(0, 60, 3), 61, 62, *range(63, 90, 3)]  # one image more than steps of 1 / 25 s
    video = write_video(tmp_path / "v.mkv", smooth(31), rate=75, times=times)
    done, notes, _ = prepared(video, tmp_path)
    left_out = [note for note in notes if "images in the time range are not used" in note]
    assert done.num_frames == 31 - int(left_out[0].split()[0]) and left_out[0].startswith("1 of 31 images")


def test_damaged_frames_are_marked_and_only_they(tmp_path):
    images = smooth(24, 96, 128)
    whole = encode(tmp_path / "whole.ts", images, options={"crf": "14", "g": "12", "bf": "0"})
    content = whole.read_bytes()
    packets = [content[i : i + 188] for i in range(0, len(content), 188)]
    kept = [packet for i, packet in enumerate(packets) if not 0.3 < i / len(packets) < 0.4]
    (tmp_path / "lost.ts").write_bytes(b"".join(kept))
    done, notes, described = prepared(tmp_path / "lost.ts", tmp_path, depth="shading")
    marked = described["unexplained_frames"]
    assert marked == list(range(marked[-1] + 1)) and done.num_frames == marked[-1] + 1 + 12  # 12 after the key frame
    assert any(f"before the next key frame: frames 0-{marked[-1]}." in note for note in notes)
    findings = find(measure(load_sequence(done.out)))
    odd = next(finding for finding in findings if finding.code == "unexplained-frames")
    assert set(odd.frames) >= set(marked) and f"--data.skip-frames 0-{marked[-1]}" in odd.fix
    assert [finding.what for finding in findings if finding.code == "video"] == list(notes)


@pytest.mark.parametrize("start", [pytest.param("black", marks=pytest.mark.slow), "bars"])
def test_the_first_images_do_not_decide_the_layout(tmp_path, start):
    images = smooth(24, 64, 96)
    empty = np.zeros_like(images[0])
    if start == "bars":
        empty[:] = (np.arange(96) // 14 * 36 % 255).astype(np.uint8)[None, :, None]
    _, _, described = prepared(write_video(tmp_path / "m.mp4", [empty] * 4 + images), tmp_path)
    assert described["sources"]["images"] == "video, mono"
    file = stereo_calibration(tmp_path)
    both = [np.vstack([image[:, :96], image[:, 6:102]]) for image in smooth(24, 64, 110)]
    video = write_video(tmp_path / "tb.mp4", [np.vstack([empty, empty])] * 4 + both)
    (tmp_path / "stereo").mkdir()
    done, _, described = prepared(video, tmp_path / "stereo", calibration=file)
    assert described["sources"]["images"] == "video, top-bottom" and done.size == (96, 64)


# --- Two files


def frames_at(*times):
    return [SourceFrame(i, time, np.zeros((1, 1, 3), np.uint8)) for i, time in enumerate(times)]


def paired(lefts, rights, offset=0.0, tolerance=0.5):
    found = pair_by_time(frames_at(*lefts), frames_at(*rights), offset, tolerance)
    return [None if other is None else other.index for _, other in found]


def test_images_are_paired_by_time():
    assert paired([0, 1, 2, 3], [0, 1, 2, 3]) == [0, 1, 2, 3]
    assert paired([0, 1, 2, 3], [0, 2, 3]) == [0, None, 1, 2]  # one is lost
    assert paired([0, 1, 2, 3], [0, 0.5, 1, 1.5, 2, 2.5, 3], tolerance=0.25) == [0, 2, 4, 6]  # twice the rate
    assert paired([0, 1, 2, 3], [0, 2], tolerance=0.5) == [0, None, 1, None]  # half of the rate
    assert paired([0, 1, 2, 3], [0, 1, 2], offset=1) == [None, 0, 1, 2]  # it starts later
    assert paired([0, 1, 2], [0, 1, 0.5, 2]) == [0, 1, 3]  # one in disorder
    assert paired([0, 1], []) == [None, None]


@pytest.fixture
def pair(tmp_path):
    """Options for two files, and (left, right) images of 30: the right camera sees all 6 px further left."""
    wide, options = smooth(30, 64, 110, step=5), {"calibration": stereo_calibration(tmp_path), "keep_right": True}
    return options, [image[:, :96] for image in wide], [image[:, 6:102] for image in wide]


def demand_pairs(out, count):
    """Each right image is the left one moved by 6 px."""
    lefts, rights = images_of(out / "images"), images_of(out / "right")
    assert len(lefts) == len(rights) == count
    assert min(psnr(left[:, 6:], right[:, :-6]) for left, right in zip(lefts, rights, strict=True)) > 26


LEFT_OUT = "images have none of the second camera and are left out"


@pytest.mark.parametrize(
    ("kept", "said"),
    [
        ([i for i in range(30) if i != 11], [f"l.mp4: 1 {LEFT_OUT}"]),  # one is lost
        pytest.param(
            list(range(12)),
            [f"l.mp4: 18 {LEFT_OUT}", "r.mp4: it ends 0.72 s before the first video"],
            marks=pytest.mark.slow,
        ),
        (
            list(range(3, 30)),
            ["r.mp4: by its time stamps it starts 0.12 s after the first video", f"l.mp4: 3 {LEFT_OUT}"],
        ),
    ],
)
def test_a_second_video_with_fewer_images_gives_the_pairs_there_are(tmp_path, pair, kept, said):
    options, lefts, rights = pair
    left = encode(tmp_path / "l.mp4", lefts)
    right = encode(tmp_path / "r.mp4", [rights[i] for i in kept], times=kept)
    done, notes, _ = prepared(left, tmp_path, right=right, **options)
    demand_pairs(done.out, len(kept))
    assert set(said) <= set(notes)


@pytest.mark.parametrize("slower", ["left", "right"])
def test_videos_of_two_rates_are_paired_by_time(tmp_path, pair, slower):
    options, lefts, rights = pair
    every = {"left": 1, "right": 1} | {slower: 2}
    files = {
        name: encode(tmp_path / f"{name}.mp4", images[:: every[name]], rate=50 // every[name])
        for name, images in (("left", lefts), ("right", rights))
    }
    done, notes, described = prepared(files["left"], tmp_path, right=files["right"], **options)
    demand_pairs(done.out, 15)
    assert described["frames_per_second"] == pytest.approx(25)
    assert any("images are paired by time" in note for note in notes)


def test_folders_of_two_cameras_are_paired_by_number(tmp_path, pair):
    options, lefts, rights = pair
    for name, images, lost in (("l", lefts, 4), ("r", rights, 9)):
        (tmp_path / name).mkdir()
        for i, image in enumerate(images[:20]):
            if i != lost:
                cv2.imwrite(str(tmp_path / name / f"{i:03d}.png"), image[..., ::-1])
    done, notes, _ = prepared(tmp_path / "l", tmp_path, right=tmp_path / "r", **options)
    demand_pairs(done.out, 18)
    assert "r: 1 images have none of the first camera and are left out" in notes
    assert "l: 1 images have none of the second camera and are left out" in notes


def test_videos_without_a_common_time_are_an_error(tmp_path, pair):
    options, lefts, rights = pair
    left = encode(tmp_path / "l.mp4", lefts)
    right = encode(tmp_path / "r.mp4", rights, times=range(100, 130))
    with pytest.raises(InputError, match=r"r\.mp4: expected images at the times of .*l\.mp4, got none\. Fix:"):
        prepared(left, tmp_path, right=right, **options)


def test_nearly_white_images_are_said(tmp_path):
    video = write_video(tmp_path / "w.mkv", [255 - image // 16 for image in smooth(12)])
    _, notes, _ = prepared(video, tmp_path, depth="none")
    assert any(note.startswith("the images are nearly white: their darkest parts have 2") for note in notes)
    with pytest.raises(InputError, match=r"expected tissue that is neither masked nor white, got none\. Fix: "):
        prepared(video, tmp_path / "shading", depth="shading")


def test_nearly_black_images_are_said(tmp_path):
    video = write_video(tmp_path / "d.mkv", [image // 16 for image in smooth(12)])
    done, notes, _ = prepared(video, tmp_path, depth="shading")
    assert any(note.startswith("the images are nearly black: their brightest parts have 1") for note in notes)
    assert "dark-images" in {finding.code for finding in find(measure(load_sequence(done.out)))}


def test_combing_that_the_file_does_not_flag_is_said(tmp_path):
    images = smooth(24, step=4)
    combed = [image.copy() for image in images[::2]]
    for image, later in zip(combed, images[1::2], strict=True):
        image[1::2] = later[1::2]
    _, notes, _ = prepared(write_video(tmp_path / "c.mkv", combed), tmp_path)
    (note,) = [note for note in notes if "rows alternate" in note]
    words = shlex.split(note.split("`")[1])
    assert words[0] == "ffmpeg" and note.startswith("c.mkv: ")
    ffmpeg(*words[1:])
    (tmp_path / "even").mkdir()
    _, notes, _ = prepared(tmp_path / "c_progressive.mp4", tmp_path / "even")
    assert not any("rows alternate" in note for note in notes)
