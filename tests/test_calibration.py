"""Calibration files: every spelling gives the same numbers; what is missing or wrong is named."""

import json

import cv2
import numpy as np
import pytest
import yaml

from endoprior.core.checks import InputError
from endoprior.prepare.calibration import check_pair
from endoprior.prepare.calibration_files import read_calibration

K1 = np.array([[580.0, 0, 318.2], [0, 582.0, 255.1], [0, 0, 1]])
K2 = np.array([[575.0, 0, 322.4], [0, 577.0, 251.9], [0, 0, 1]])
D1, D2 = np.array([-0.1, 0.02, 0.001, -0.002, 0.003]), np.array([-0.12, 0.03, 0, 0, 0])
R = cv2.Rodrigues(np.array([0.002, -0.01, 0.003]))[0]
T = np.array([-4.2, 0.05, -0.03])


def opencv_yaml(path, **items):
    storage = cv2.FileStorage(str(path), cv2.FILE_STORAGE_WRITE)
    for name, value in items.items():
        storage.write(name, value)
    storage.release()
    return path


def as_json(path, **items):
    path.write_text(json.dumps({name: np.asarray(value).tolist() for name, value in items.items()}))
    return path


QUANTITIES = {"K_left": K1, "D_left": D1, "K_right": K2, "D_right": D2, "R": R, "T": T, "size": np.array([640, 512])}
FORMS = {
    "c.yaml": "M1 D1 M2 D2 R T imageSize",
    "c.yml": "cameraMatrix1 distCoeffs1 cameraMatrix2 distCoeffs2 R T image_size",
    "c.json": "K_left distortion_left K_right distortion_right R T_mm size",
    "c.npz": "left_camera_matrix left_dist_coeffs right_camera_matrix right_dist rotation translation resolution",
    "m.json": "K1 dist1 K2 dist2 R T shape",
}
"""A name for each of the quantities; in the last file T is in m."""


@pytest.mark.parametrize("name", FORMS)
def test_every_file_format_gives_the_same_numbers(tmp_path, name):
    path, items = tmp_path / name, dict(zip(FORMS[name].split(), QUANTITIES.values(), strict=True))
    if name == "m.json":
        items["T"] = T / 1000
    if path.suffix == ".npz":
        np.savez(path, **items)
    else:
        (as_json if path.suffix == ".json" else opencv_yaml)(path, **items)
    found = read_calibration(path)
    half = np.zeros((3, 3))
    half[:2, 2] = 0.5  # OpenCV counts pixel centers from 0, we from 0.5
    assert np.allclose(found.left.matrix, K1 + half) and np.allclose(found.right.matrix, K2 + half)
    assert np.allclose(found.left.distortion[:5], D1) and np.allclose(found.right.distortion[:5], D2)
    assert np.allclose(found.rotation, R) and np.allclose(found.translation_mm, T)
    assert found.size == (640, 512) and not found.rectified
    assert check_pair(found, "c") == pytest.approx(np.linalg.norm(T))


def test_one_camera(tmp_path):
    found = read_calibration(opencv_yaml(tmp_path / "c.yaml", camera_matrix=K1, distortion_coefficients=D1))
    assert found.right is None and np.allclose(found.left.distortion, D1) and found.size is None
    with pytest.raises(InputError, match=r"expected both cameras, R and T, got one camera.*--layout mono"):
        check_pair(found, "c.yaml")


@pytest.mark.parametrize(
    "bent", [{"distortion_coefficients": D1}, {"dist": D1}, dict(zip(("k1", "k2", "p1", "p2", "k3"), D1, strict=True))]
)
def test_distortion_next_to_single_numbers(tmp_path, bent):
    path, numbers = tmp_path / "c.yaml", {"fx": 580, "fy": 582, "cx": 318.2, "cy": 255.1}
    path.write_text(yaml.safe_dump(numbers | {name: np.asarray(value).tolist() for name, value in bent.items()}))
    found = read_calibration(path)
    assert np.allclose(found.left.distortion[:5], D1) and found.left.matrix[0, 2] == 318.7
    with pytest.raises(InputError, match="k1 to be a number"):
        path.write_text("{fx: 1, fy: 1, cx: 1, cy: 1, k1: x}")
        read_calibration(path)


def test_the_unit_option(tmp_path):
    path = as_json(tmp_path / "c.json", K1=K1, K2=K2, R=R, T=T / 10)
    assert np.allclose(read_calibration(path, "cm").translation_mm, T)
    with pytest.raises(InputError, match=r"baseline of 1 to 30 mm, got 0\.42.*--calibration-unit"):
        check_pair(read_calibration(path), "c.json")


def pair(**items):
    return json.dumps({"K1": K1.tolist(), "K2": K2.tolist()} | items)


FORMATS = "a calibration of OpenCV, ROS, Kalibr, ORB-SLAM, COLMAP or the da Vinci, or rows of numbers"
BROKEN = {
    "no suffix": ("c", "x", FORMATS),
    "not json": ("c.json", "{", "a readable calibration"),
    "a list": ("c.json", "[1]", "rows of numbers, got a list"),
    "pickle in npz": ("c.npz", "x", "a readable calibration"),
    "python in yaml": ("c.yaml", "K_left: !!python/object/apply:os.system ['true']", "a readable calibration"),
    "no matrix": ("c.json", '{"R": 1}', "the left camera matrix"),
    "no R": ("c.json", pair(), "the relative pose of the cameras"),
    "short T": ("c.json", pair(R=R.tolist(), T=[1]), "t to have 3 numbers"),
    "NaN": ("c.json", '{"K1": [[NaN,0,0],[0,1,0],[0,0,1]]}', "k of the only camera to be finite"),
    "no rotation": ("c.json", pair(R=K1.tolist(), T=[1, 2, 3]), "R to be a rotation"),
    "no focal length": ("c.json", '{"K1": [[0,0,0],[0,1,0],[0,0,1]]}', "a camera matrix"),
    "coefficients": ("c.json", pair(D1=[0] * 7), "distortion coefficients"),
    "ini without focal length": ("c.ini", "[StereoLeft]\nfc_x=1\n[StereoRight]\n", "fc_x, fc_y, cc_x, cc_y"),
    "size": ("c.json", json.dumps({"K1": K1.tolist(), "width": 0, "height": 3}), "width and height in px"),
}


@pytest.mark.parametrize("kind", BROKEN)
def test_broken_files_give_one_error_line(tmp_path, kind):
    name, content, says = BROKEN[kind]
    (tmp_path / name).write_text(content)
    with pytest.raises(InputError) as error:
        read_calibration(tmp_path / name)
    assert says in str(error.value) and str(tmp_path / name) in str(error.value) and "\n" not in str(error.value)


@pytest.mark.parametrize(
    ("shift", "says"),
    [((4.2, 0, 0), "left and right are swapped"), ((0, -4.2, 0), "T along x"), ((-90, 0, 0), "got 90 mm")],
)
def test_implausible_pairs_are_errors(tmp_path, shift, says):
    path = as_json(tmp_path / "c.json", K1=K1, K2=K2, R=np.eye(3), T=shift)
    with pytest.raises(InputError, match=says):
        check_pair(read_calibration(path), "c.json")
