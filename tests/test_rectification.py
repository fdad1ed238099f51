"""Frames of bent, squeezed and misaligned cameras: points of a known place must land where the frame's camera says."""

import cv2
import numpy as np
import pytest

from endoprior.core.checks import InputError
from endoprior.prepare.calibration import Calibration, Intrinsics
from endoprior.prepare.frame_geometry import make_geometry, rectify, with_rows_moved

SIZE = 320, 240
ROTATION = cv2.Rodrigues(np.array([0.01, -0.02, 0.015]))[0]
TRANSLATION = np.array([-4.5, 0.1, 0.05])
POINTS = np.random.default_rng(0).uniform((-18, -13, 55), (18, 13, 90), (60, 3))
"""(60, 3) mm, in front of the left camera."""
LENSES = {
    "fisheye": (True, (-0.02, 0.01, 0.03, -0.02), (-0.03, 0.02, 0.01, -0.01)),
    "wide fisheye": (True, (0.05, -0.02, 0.004, 0.0), (0.04, -0.01, 0.002, 0.0)),
    "bare fisheye": (True, (0.0, 0.0, 0.0, 0.0), (0.0, 0.0, 0.0, 0.0)),
    "usual": (False, (-0.2, 0.05, 0.001, 0.0, 0.0), (-0.15, 0.02, 0.0, 0.001, 0.0)),
}


def lens(kind, right=False):
    fisheye, *bent = LENSES[kind]
    f, cx, cy = (196, 165.5, 118.5) if right else (200, 160.5, 120.5)
    return Intrinsics(np.array([[f, 0, cx], [0, f + 1, cy], [0, 0, 1.0]]), np.array(bent[right]), fisheye)


def seen(camera, rotation, translation):
    """(N, 2) where a source camera sees the points, px from the image's corner."""
    k = camera.matrix - [[0, 0, 0.5], [0, 0, 0.5], [0, 0, 0]]
    project = cv2.fisheye.projectPoints if camera.fisheye else cv2.projectPoints
    args = (POINTS[:, None], cv2.Rodrigues(rotation)[0], translation.reshape(3, 1), k, camera.distortion)
    return project(*args)[0][:, 0] + 0.5


def in_frame(geometry, matrix, points):
    pixels = points @ matrix.T
    return pixels[:, :2] / pixels[:, 2:]


def source_of(geometry, right, pixels):
    """(N, 2) where the maps take pixels of the whole rectified image, px from the corner."""
    at = (pixels - 0.5).astype(np.float32)
    maps = geometry.maps[int(right)]
    return np.stack([cv2.remap(m, at[:, None, 0], at[:, None, 1], cv2.INTER_LINEAR)[:, 0] for m in maps], 1) + 0.5


@pytest.mark.parametrize("kind", LENSES)
def test_one_camera_is_undistorted(kind):
    camera = lens(kind)
    geometry = make_geometry(SIZE, Calibration(camera), stereo=False, name="c", field_of_view_degrees=70, max_width=0)
    pixels = in_frame(geometry, geometry.matrix, POINTS)
    inside = ((pixels > 2) & (pixels < np.array(SIZE) - 2)).all(1)
    error = np.linalg.norm(source_of(geometry, False, pixels) - seen(camera, np.eye(3), np.zeros(3)), axis=1)
    assert inside.sum() > 30 and error[inside].max() < 0.05
    columns, rows = geometry.maps[0]  # every pixel of a frame shows something
    assert min(columns.min(), rows.min()) > -1.5 and columns.max() < SIZE[0] + 0.5 and rows.max() < SIZE[1] + 0.5
    assert geometry.inside.mean() > 0.98 and np.array_equal(geometry.turn, np.eye(3))


@pytest.mark.parametrize("kind", LENSES)
@pytest.mark.parametrize("stretch", [(1, 1), (2, 1), (1, 2)])
def test_a_pair_is_rectified(kind, stretch):
    """Points land where both frame cameras say; a squeezed source is stretched on the way."""
    left, right = lens(kind), lens(kind, right=True)
    source = SIZE[0] // stretch[0], SIZE[1] // stretch[1]
    geometry = make_geometry(
        source, Calibration(left, right, ROTATION, TRANSLATION), stereo=True, name="c", stretch=stretch,
        field_of_view_degrees=70, max_width=0,
    )  # fmt: skip
    assert geometry.size == SIZE and geometry.baseline_mm == pytest.approx(np.linalg.norm(TRANSLATION))
    turned = POINTS @ geometry.turn.T
    for is_right, camera, pose in ((False, left, (np.eye(3), np.zeros(3))), (True, right, (ROTATION, TRANSLATION))):
        pixels = in_frame(geometry, geometry.matrix, turned - [geometry.baseline_mm * is_right, 0, 0])
        inside = ((pixels > 2) & (pixels < np.array(SIZE) - 2)).all(1)
        error = np.abs(source_of(geometry, is_right, pixels) - seen(camera, *pose) / stretch)
        assert inside.sum() > 20 and error[inside].max() < 0.05


def test_a_squeezed_rectified_pair_is_only_stretched():
    camera = Intrinsics(np.array([[300.0, 0, 160], [0, 300, 120], [0, 0, 1]]), np.zeros(0))
    calibration = Calibration(camera, camera, np.eye(3), np.array([-4.0, 0, 0]))
    options = dict(stereo=True, name="c", field_of_view_degrees=70, max_width=0)
    geometry = make_geometry((160, 240), calibration, stretch=(2, 1), **options)
    wide = np.repeat(np.linspace(0, 250, 320)[None, :, None], 240, 0).repeat(3, 2).astype(np.uint8)
    half = cv2.resize(wide, (160, 240), interpolation=cv2.INTER_AREA)
    assert np.abs(geometry.image(half).astype(int) - wide)[:, 4:-4].max() <= 1
    assert np.allclose(geometry.matrix, camera.matrix) and geometry.inside.all()
    assert geometry.values(np.ones((240, 160), bool)).shape == (240, 320)


@pytest.mark.parametrize("bent", [True, False])
def test_rows_of_the_right_camera_are_moved(bent):
    """A right camera that sees everything 3.5 rows too low: afterwards both rows agree."""
    left = lens("usual") if bent else Intrinsics(np.array([[300.0, 0, 160], [0, 300, 120], [0, 0, 1]]), np.zeros(0))
    calibration = Calibration(left, left, np.eye(3), np.array([-4.0, 0, 0]))
    options = dict(stereo=True, name="c", field_of_view_degrees=70)
    geometry = make_geometry(SIZE, calibration, **options, max_width=160)
    noise = cv2.GaussianBlur(np.random.default_rng(1).random((*SIZE[::-1], 3), np.float32), (0, 0), 4)
    rgb_u8 = cv2.normalize(noise, None, 0, 255, cv2.NORM_MINMAX).astype(np.uint8)
    frame = geometry.image(rgb_u8)
    low = cv2.warpAffine(rgb_u8, np.float32([[1, 0, 0], [0, 1, 7]]), SIZE)
    before = np.abs(geometry.image(low, right=True).astype(int) - frame)[20:-20].mean()
    offset = 7 * geometry.matrix[1, 1] / left.matrix[1, 1]
    after = np.abs(with_rows_moved(geometry, offset).image(low, right=True).astype(int) - frame)[20:-20].mean()
    assert before > 20 and after < (8 if bent else 2)  # bent: 7 rows of the source are not 7 everywhere


def test_one_fisheye_of_two_and_hopeless_coefficients_are_errors():
    with pytest.raises(InputError, match="two lenses of one model"):
        rectify(Calibration(lens("fisheye"), lens("usual"), ROTATION, TRANSLATION), SIZE, "c", stereo=True)
    k = lens("usual").matrix
    for bent in ((-9.0, 4, 0, 0), (50.0, 0, 0, 0)):
        with pytest.raises(InputError, match="a distortion that can be undone"):
            rectify(Calibration(Intrinsics(k, np.array(bent))), SIZE, "c", stereo=False)
