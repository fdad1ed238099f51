"""Of images of which size a calibration is: decided by what the file says and its principal point, or asked."""

import json

import numpy as np
import pytest

from endoprior.core.checks import InputError
from endoprior.prepare.calibration import Calibration, Intrinsics, fitted, parse_size
from endoprior.prepare.calibration_files import read_calibration

K1 = np.array([[580.0, 0, 318.2], [0, 582.0, 255.1], [0, 0, 1]])
K2 = np.array([[575.0, 0, 322.4], [0, 577.0, 251.9], [0, 0, 1]])


def written(path, k=K1, **items):
    stored = {"K": k.tolist()} | items
    path.write_text(json.dumps(stored))
    return read_calibration(path)


def at(x, y, size=None, **more):
    """A camera with this principal point."""
    return Calibration(Intrinsics(np.array([[500.0, 0, x], [0, 500, y], [0, 0, 1]]), np.zeros(0)), size=size, **more)


def fit(calibration, width, height, squeezed=False):
    return fitted(calibration, (width, height), "c.json", squeezed=squeezed)


def test_a_stated_size_scales_the_matrix_and_is_said(tmp_path):
    found, notes = fit(written(tmp_path / "c.json", width=640, height=512), 1280, 1024)
    assert found.left.matrix[0, 0] == 1160 and found.left.matrix[0, 2] == pytest.approx(2 * 318.7)
    assert notes == ["the calibration is scaled from 640x512 to 1280x1024 px"]
    with pytest.raises(InputError, match="expected images of 640x512 px, or the same aspect ratio, got 720x480"):
        fit(written(tmp_path / "c.json", width=640, height=512), 720, 480)


@pytest.mark.parametrize("center", [(320, 256), (300, 262), (345, 240)])
def test_without_a_size_a_principal_point_that_fits_is_taken_and_said(center):
    found, notes = fit(at(*center), 640, 512)
    assert found.size == (640, 512) and found.left.matrix[0, 0] == 500
    assert "states no image size; 640x512 px are taken" in notes[0] and "--calibration-size" in notes[0]


@pytest.mark.parametrize(
    ("center", "likely"),
    [
        ((640, 512), "1280x1024"),  # twice
        ((160, 128), "320x256"),  # half
        ((240, 192), "480x384"),  # three quarters
        ((420, 336), "853x683"),  # four thirds, nearly
        ((600, 530), "1280x1024"),  # twice, and off center
        ((362, 290), "724x580"),  # 1.13: no usual ratio
    ],
)
def test_without_a_size_another_principal_point_asks_with_the_likely_answer(center, likely):
    with pytest.raises(InputError) as error:
        fit(at(*center), 640, 512)
    assert f"got no size, and ({center[0] - 0.5:g}, {center[1] - 0.5:g})" in str(error.value)
    assert f"`--calibration-size {likely}`" in str(error.value) and "\n" not in str(error.value)


def test_both_cameras_together_tell_the_center():
    """Cameras that converge have principal points off center on either side."""
    left, right = at(275, 256).left, at(365, 256).left
    assert fit(Calibration(left, right), 640, 512)[0].size == (640, 512)
    with pytest.raises(InputError):
        fit(Calibration(left), 640, 512)


@pytest.mark.parametrize(("center", "size"), [((320, 256), (320, 512)), ((320, 256), (640, 256))])
def test_a_squeezed_video_is_named(center, size):
    for stated in (None, (640, 512)):
        with pytest.raises(InputError, match=r"`--squeezed-eyes` if both cameras share a frame"):
            fit(at(*center, stated), *size)


def test_a_crop_without_a_size_asks():
    with pytest.raises(InputError, match=r"`--calibration-size WIDTHxHEIGHT` with the size of its images"):
        fit(at(960, 540), 1350, 1080)


def test_a_stated_size_that_contradicts_the_principal_point_is_an_error():
    with pytest.raises(InputError, match=r"near the center of its 320x256 px, got \(319.5, 255.5\)"):
        fit(at(320, 256, (320, 256)), 320, 256)
    found, _ = fit(at(320, 256, (320, 256), size_is_sure=True), 320, 256)  # a crop that this program wrote
    assert found.left.matrix[0, 2] == 320


@pytest.mark.parametrize("pair", [[640, 512], [512, 640], [512, 640, 3], ["512", "640"]])
def test_height_and_width_of_numpy_are_told_by_the_principal_point(tmp_path, pair):
    found = written(tmp_path / "c.json", image_size=pair)
    assert found.size == (640, 512)
    said = [note for note in found.notes if "is read as height, width" in note]
    assert bool(said) == (str(pair[0]) == "512")


def test_a_size_of_the_users(tmp_path):
    assert parse_size("1280x1024") == parse_size("1280,1024") == (1280, 1024)
    for text in ("1280", "0x3", "axb", "-1x5"):
        with pytest.raises(InputError, match="--calibration-size: expected WIDTHxHEIGHT in px"):
            parse_size(text)
