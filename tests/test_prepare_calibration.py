"""Stereo videos with awkward calibrations, from the command line to depth: a flat wall 70 mm away."""

import json
from fractions import Fraction

import cv2
import numpy as np
import pytest
from video_files import encode, write_video

from endoprior.check import find, measure
from endoprior.cli import main
from endoprior.data import load_sequence

WIDTH, HEIGHT, FOCAL, BASELINE, DEPTH = 320, 256, 300.0, 4.2, 70.0
DISPARITY = round(FOCAL * BASELINE / DEPTH)
"""px; 18 exactly."""
QUICK = ["--masks", "none", "--poses", "still"]


def wall(seed):
    noise = np.random.default_rng(seed).standard_normal((HEIGHT, WIDTH + DISPARITY)).astype(np.float32)
    texture = sum(cv2.GaussianBlur(noise, (0, 0), sigma) * sigma for sigma in (1, 3, 8))
    texture = 128 + 60 * texture / texture.std()
    rgb_u8 = np.clip(np.stack([texture, 0.6 * texture, 0.5 * texture], -1), 0, 255).astype(np.uint8)
    return np.ascontiguousarray(rgb_u8[:, :WIDTH]), np.ascontiguousarray(rgb_u8[:, DISPARITY:])


PAIRS = [wall(seed) for seed in range(3)]


def calibration(path, scale=1.0, **more):
    k = [[FOCAL * scale, 0, 160 * scale], [0, FOCAL * scale, 128 * scale], [0, 0, 1]]
    pair = {"K_left": k, "K_right": k, "D_left": [0.0] * 4, "R": np.eye(3).tolist(), "T_mm": [-BASELINE, 0, 0]}
    path.write_text(json.dumps(pair | more))
    return path


def side_by_side(path, squeezed=False, low=0):
    frames = [np.concatenate([left, np.roll(right, low, 0)], 1) for left, right in PAIRS]
    if squeezed:
        frames = [cv2.resize(frame, (WIDTH, HEIGHT), interpolation=cv2.INTER_AREA) for frame in frames]
    return write_video(path, frames)


def prepare(tmp_path, video, calibrated, *more):
    return main(["prepare", str(video), str(tmp_path / "DATA"), "--calibration", str(calibrated), *QUICK, *more])


def depth_of(folder):
    """Median depth, mm, and the share of pixels with depth within 2 % of the truth."""
    frame = load_sequence(folder).frame(1)
    inner = np.s_[10:-10, DISPARITY + 12 : -10]
    right = np.abs(frame.depth / DEPTH - 1)[inner] < 0.02
    return float(np.median(frame.depth[frame.depth_valid])), float((right & frame.depth_valid[inner]).mean())


def codes(folder):
    return {finding.code: finding for finding in find(measure(load_sequence(folder)))}


def test_a_calibration_of_another_size_is_asked_for_and_then_right(tmp_path, capsys):
    video, double = side_by_side(tmp_path / "v.mkv"), calibration(tmp_path / "double.json", 2)
    assert prepare(tmp_path, video, double) == 2
    said = capsys.readouterr().err
    assert "`--calibration-size 640x512`" in said and said.count("\n") == 1 and not (tmp_path / "DATA").exists()
    assert prepare(tmp_path, video, double, "--calibration-size", "640x512") == 0
    depth, share = depth_of(tmp_path / "DATA")
    assert depth == pytest.approx(DEPTH, rel=0.005) and share > 0.95
    assert "calibration-size" not in codes(tmp_path / "DATA")


def test_a_size_decided_by_the_principal_point_is_said_by_prepare_and_check(tmp_path, capsys):
    assert prepare(tmp_path, side_by_side(tmp_path / "v.mkv"), calibration(tmp_path / "c.json")) == 0
    assert "states no image size; 320x256 px are taken" in capsys.readouterr().out
    assert depth_of(tmp_path / "DATA")[0] == pytest.approx(DEPTH, rel=0.005)
    assert "--calibration-size WIDTHxHEIGHT" in codes(tmp_path / "DATA")["calibration-size"].fix


@pytest.mark.parametrize("size", [{}, {"width": WIDTH, "height": HEIGHT}])
def test_squeezed_eyes(tmp_path, capsys, size):
    video = side_by_side(tmp_path / "v.mkv", squeezed=True)
    calibrated = calibration(tmp_path / "c.json", **size)
    assert prepare(tmp_path, video, calibrated) == 2 and "`--squeezed-eyes`" in capsys.readouterr().err
    assert prepare(tmp_path, video, calibrated, "--squeezed-eyes") == 0
    sequence = load_sequence(tmp_path / "DATA")
    assert (sequence.camera(0).width, sequence.camera(0).height) == (WIDTH, HEIGHT)
    assert sequence.camera(0).fx == sequence.camera(0).fy == FOCAL
    depth, share = depth_of(tmp_path / "DATA")
    assert depth == pytest.approx(DEPTH, rel=0.01) and share > 0.9
    assert main(["prepare", str(tmp_path / "v.mkv"), str(tmp_path / "M"), "--layout", "mono", "--squeezed-eyes"]) == 2
    assert "--squeezed-eyes: expected both cameras" in capsys.readouterr().err


@pytest.mark.slow
def test_the_row_offset_is_measured_and_undone(tmp_path, capsys):
    video, calibrated = side_by_side(tmp_path / "v.mkv", low=5), calibration(tmp_path / "c.json", width=320, height=256)
    assert prepare(tmp_path, video, calibrated, "--keep-right") == 0
    assert "--row-offset auto" in capsys.readouterr().out
    before = depth_of(tmp_path / "DATA")[1]
    assert "--row-offset auto" in codes(tmp_path / "DATA")["vertical-offset"].fix
    (tmp_path / "DATA").rename(tmp_path / "first")
    assert prepare(tmp_path, video, calibrated, "--keep-right", "--row-offset", "auto") == 0
    assert "moved up by 5.00 px: the rows of both cameras were 5.00 px apart, now 0.00" in capsys.readouterr().out
    assert depth_of(tmp_path / "DATA")[1] > 0.95 > 0.6 > before and "vertical-offset" not in codes(tmp_path / "DATA")
    mono = str(write_video(tmp_path / "m.mkv", [left for left, _ in PAIRS]))
    assert main(["prepare", mono, str(tmp_path / "M"), "--row-offset", "auto", *QUICK]) == 2
    assert "--row-offset: expected two cameras, got one camera" in capsys.readouterr().err


def test_the_fix_of_a_camera_for_another_size_corrects_depth_too(tmp_path):
    """A folder that an earlier version made with focal length, center and depth twice too large."""
    video, double = side_by_side(tmp_path / "v.mkv"), calibration(tmp_path / "double.json", 2)
    assert prepare(tmp_path, video, double, "--calibration-size", "320x256") == 0
    assert depth_of(tmp_path / "DATA")[0] == pytest.approx(2 * DEPTH, rel=0.01)
    fix = codes(tmp_path / "DATA")["intrinsics"].fix
    assert "--calibration-size 641x513" in fix or "--calibration-size 640x512" in fix
    edit = json.loads("{" + fix.split(" in ")[0].removeprefix("set ") + "}")
    described = json.loads((tmp_path / "DATA" / "sequence.json").read_text())
    (tmp_path / "DATA" / "sequence.json").write_text(json.dumps(described | edit))
    assert depth_of(tmp_path / "DATA")[0] == pytest.approx(DEPTH, rel=0.01)
    assert load_sequence(tmp_path / "DATA").camera(0).fx == pytest.approx(FOCAL, rel=0.01)
    assert "intrinsics" not in codes(tmp_path / "DATA")


# --- Options together


@pytest.mark.slow
@pytest.mark.parametrize("of_stored_pixels", [False, True])
def test_squeezed_eyes_of_pixels_that_are_not_square(tmp_path, capsys, of_stored_pixels):
    frames = [np.concatenate(each, 1) for each in PAIRS]
    stored = [cv2.resize(frame, (WIDTH * 3 // 4, HEIGHT), interpolation=cv2.INTER_AREA) for frame in frames]
    video = encode(tmp_path / "v.mp4", stored, sample_aspect_ratio=Fraction(4, 3))
    calibrated = calibration(tmp_path / "c.json", width=WIDTH, height=HEIGHT)
    if of_stored_pixels:
        k = [[FOCAL * 3 / 4, 0, 120], [0, FOCAL, 128], [0, 0, 1]]
        calibrated = calibration(tmp_path / "c.json", width=240, height=HEIGHT, K_left=k, K_right=k)
    assert prepare(tmp_path, video, calibrated, "--squeezed-eyes", "--layout", "side-by-side") == 0
    camera = load_sequence(tmp_path / "DATA").camera(0)
    assert (camera.width, camera.height, camera.fx, camera.fy) == pytest.approx((WIDTH, HEIGHT, FOCAL, FOCAL))
    depth, share = depth_of(tmp_path / "DATA")
    assert depth == pytest.approx(DEPTH, rel=0.02) and share > 0.8


def test_a_row_offset_of_squeezed_eyes(tmp_path, capsys):
    video = side_by_side(tmp_path / "v.mkv", squeezed=True, low=5)
    calibrated = calibration(tmp_path / "c.json", width=WIDTH, height=HEIGHT)
    words = "--squeezed-eyes", "--layout", "side-by-side", "--row-offset", "auto"
    assert prepare(tmp_path, video, calibrated, *words) == 0
    assert "moved up by 5.0" in capsys.readouterr().out and depth_of(tmp_path / "DATA")[1] > 0.9


def test_a_fisheye_of_another_size(tmp_path):
    video = write_video(tmp_path / "v.mkv", [left for left, _ in PAIRS])
    bent = {"model": "fisheye", "D": [-0.05, 0.01, 0.0, 0.0], "pixel_center": 0.5}
    for scale, name in ((1, "same"), (2, "double")):
        k = [[FOCAL * scale, 0, 158 * scale], [0, FOCAL * scale, 130 * scale], [0, 0, 1]]
        file = tmp_path / f"{name}.json"
        file.write_text(json.dumps(bent | {"K": k, "width": WIDTH * scale, "height": HEIGHT * scale}))
        words = ["--calibration", str(file), "--depth", "none", "--layout", "mono", "--border", "keep", *QUICK]
        assert main(["prepare", str(video), str(tmp_path / f"out_{name}"), *words]) == 0
    same, double = (load_sequence(tmp_path / f"out_{name}") for name in ("same", "double"))
    a, b = same.camera(0), double.camera(0)
    assert (a.width, a.height, a.fx, a.fy, a.cx, a.cy) == pytest.approx((b.width, b.height, b.fx, b.fy, b.cx, b.cy))
    assert np.abs(same.frame(1).rgb_u8.astype(int) - double.frame(1).rgb_u8).max() <= 1
    assert np.abs(same.frame(1).rgb_u8[:, :300].astype(int) - PAIRS[1][0][:, :300]).mean() > 5  # undistorted


def test_masks_with_labels_of_every_second_frame(tmp_path, capsys):
    video = write_video(tmp_path / "v.mkv", [left for left, _ in PAIRS * 2])
    (tmp_path / "m").mkdir()
    for i in (0, 2, 4):
        labels = np.zeros((HEIGHT, WIDTH), np.uint8)
        labels[:100, :120], labels[100:200, : 40 + 20 * i] = 1, 2  # tissue and a tool
        cv2.imwrite(str(tmp_path / f"m/{i:04d}.png"), labels)
    words = ["--masks", str(tmp_path / "m"), "--mask-labels", "2", "--depth", "none", "--poses", "still"]
    assert main(["prepare", str(video), str(tmp_path / "DATA"), *words]) == 0
    assert "one for every 2 frames; 3 of 6 frames have none and are left out" in capsys.readouterr().out
    masks = [cv2.imread(str(file), 0) > 0 for file in sorted((tmp_path / "DATA/masks").iterdir())]
    assert [int(mask[150].sum()) for mask in masks] == [40, 80, 120] and not any(mask[:100].any() for mask in masks)
    images = [cv2.imread(str(file))[..., ::-1] for file in sorted((tmp_path / "DATA/images").iterdir())]
    assert all((images[i] == PAIRS[j][0]).all() for i, j in ((0, 0), (1, 2), (2, 1)))
