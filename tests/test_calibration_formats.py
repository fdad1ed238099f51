"""Calibration files of other programs, in their exact layout: each gives the right numbers, or names its format."""

import codecs
import json
import struct

import cv2
import numpy as np
import pytest

from endoprior.core.checks import InputError
from endoprior.data.lens import MODELS, UNSUPPORTED, Lens
from endoprior.prepare.calibration import check_pair
from endoprior.prepare.calibration_files import read_calibration

K1 = np.array([[580.0, 0, 318.2], [0, 582.0, 255.1], [0, 0, 1]])
K2 = np.array([[575.0, 0, 322.4], [0, 577.0, 251.9], [0, 0, 1]])
D1, D2 = np.array([-0.1, 0.02, 0.001, -0.002]), np.array([-0.12, 0.03, 0.002, 0.001])
R = cv2.Rodrigues(np.array([0.002, -0.01, 0.003]))[0]
T = np.array([-4.2, 0.05, -0.03])
HALF = np.array([[0, 0, 0.5], [0, 0, 0.5], [0, 0, 0]])
"""OpenCV and all others count pixel centers from 0, we from 0.5."""


def rows(matrix):
    return json.dumps(np.asarray(matrix).tolist())


def to_right():
    """4x4 from left to right camera coordinates, m."""
    pose = np.eye(4)
    pose[:3, :3], pose[:3, 3] = R, T / 1000
    return pose


def matrix_yaml(name, values):
    values = np.atleast_2d(values)
    data = ", ".join(repr(float(v)) for v in values.ravel())
    return (
        f"{name}: !!opencv-matrix\n   rows: {len(values)}\n   cols: {values.shape[1]}\n   dt: d\n   data: [ {data} ]\n"
    )


def kalibr(model="pinhole", numbers=()):
    text = ""
    for i, (k, d) in enumerate(((K1, D1), (K2, D2))):
        text += f"cam{i}:\n  cam_overlaps: [{1 - i}]\n  camera_model: {model}\n  distortion_coeffs: {rows(d)}\n"
        text += f"  distortion_model: radtan\n  intrinsics: {rows([*numbers, k[0, 0], k[1, 1], k[0, 2], k[1, 2]])}\n"
        text += f"  resolution: [640, 512]\n  rostopic: /cam{i}/image_raw\n"
        if i:
            text += "  T_cn_cnm1:\n" + "".join(f"  - {rows(row)}\n" for row in to_right())
    return text


def orb_slam3():
    text = '%YAML:1.0\n\n#----\nFile.version: "1.0"\nCamera.type: "PinHole"\n'
    for i, (k, d) in enumerate(((K1, D1), (K2, D2)), 1):
        names = zip(("fx", "fy", "cx", "cy"), (k[0, 0], k[1, 1], k[0, 2], k[1, 2]), strict=True)
        text += "".join(f"Camera{i}.{name}: {value!r}\n" for name, value in ((n, float(v)) for n, v in names))
        text += "".join(f"Camera{i}.{n}: {float(v)!r}\n" for n, v in zip(("k1", "k2", "p1", "p2"), d, strict=True))
    text += "Camera.width: 640\nCamera.height: 512\nCamera.fps: 20\nStereo.ThDepth: 60.0\n"
    return text + matrix_yaml("Stereo.T_c1_c2", np.linalg.inv(to_right()))


def rectification():
    size = (640, 512)
    return cv2.stereoRectify(K1, D1, K2, D2, size, R, T.reshape(3, 1) / 1000, flags=cv2.CALIB_ZERO_DISPARITY)[:4]


def orb_slam2():
    r1, r2, p1, p2 = rectification()
    text = f"%YAML:1.0\nCamera.fx: {p1[0, 0]}\nCamera.fy: {p1[1, 1]}\nCamera.cx: {p1[0, 2]}\nCamera.cy: {p1[1, 2]}\n"
    text += f"Camera.k1: 0.0\nCamera.k2: 0.0\nCamera.p1: 0.0\nCamera.p2: 0.0\nCamera.bf: {-p2[0, 3]}\n"
    for side, k, d, r, p in (("LEFT", K1, D1, r1, p1), ("RIGHT", K2, D2, r2, p2)):
        text += f"{side}.height: 512\n{side}.width: 640\n"
        text += "".join(matrix_yaml(f"{side}.{name}", value) for name, value in zip("DKRP", (d, k, r, p), strict=True))
    return text


def ros_pair():
    text, (r1, r2, p1, p2) = "", rectification()
    for side, k, d, r, p in (("left", K1, D1, r1, p1), ("right", K2, D2, r2, p2)):
        text += f"{side}:\n  image_width: 640\n  image_height: 512\n  distortion_model: plumb_bob\n"
        names = "camera_matrix", "distortion_coefficients", "rectification_matrix", "projection_matrix"
        for name, m in zip(names, (k, d[None], r, p), strict=True):
            text += f"  {name}: {{rows: {m.shape[0]}, cols: {m.shape[1]}, data: {rows(m.ravel())}}}\n"
    return text


def opencv_storage(suffix):
    storage = cv2.FileStorage(suffix, cv2.FILE_STORAGE_WRITE | cv2.FILE_STORAGE_MEMORY)
    for name, value in dict(K1=K1, D1=D1, K2=K2, D2=D2, R=R, T=T).items():
        storage.write(name, value)
    storage.write("image_size", np.array([512.0, 640.0]))  # scared_toolkit writes height, width
    return storage.releaseAndGetString()


def da_vinci():
    text = "; geändert\n"
    for side, k, d in (("Left", K1, D1), ("Right", K2, D2)):
        text += (
            f"[Stereo{side}]\nres_x=640\nres_y=512\nfc_x={k[0, 0]}\nfc_y={k[1, 1]}\ncc_x={k[0, 2]}\ncc_y={k[1, 2]}\n"
        )
        text += "".join(f"kc_{i}={v!r}\n" for i, v in enumerate(map(float, d)))
        r, t = (R, T) if side == "Right" else (np.eye(3), np.zeros(3))
        text += "".join(f"R_{i}={v!r}\n" for i, v in enumerate(map(float, r.ravel())))
        text += "".join(f"T_{i}={v!r}\n" for i, v in enumerate(map(float, t)))
    return text


PAIRS = {
    "Kalibr": ("camchain.yaml", kalibr),
    "ORB-SLAM3": ("settings.yaml", orb_slam3),
    "ORB-SLAM2": ("settings.yaml", orb_slam2),
    "ROS": ("stereo.yaml", ros_pair),
    "OpenCV XML": ("c.xml", lambda: opencv_storage("c.xml")),
    "OpenCV JSON": ("c.json", lambda: opencv_storage("c.json")),
    "OpenCV YAML, other suffix": ("c.txt", lambda: opencv_storage("c.yml")),
    "da Vinci": ("StereoCalibration.ini", da_vinci),
}


@pytest.mark.parametrize("form", PAIRS)
def test_pairs_of_other_programs(tmp_path, form):
    name, text = PAIRS[form]
    (tmp_path / name).write_text(text(), encoding="latin-1")
    found = read_calibration(tmp_path / name)
    assert np.allclose(found.left.matrix, K1 + HALF) and np.allclose(found.right.matrix, K2 + HALF)
    assert np.allclose(found.left.distortion[:4], D1) and np.allclose(found.right.distortion[:4], D2)
    assert np.allclose(found.rotation, R, atol=1e-6) and np.allclose(found.translation_mm, T, atol=1e-4)
    assert found.size == (640, 512) and not found.left.fisheye


def test_the_rectified_camera_of_orb_slam(tmp_path):
    text = "%YAML:1.0\nCamera.type: Rectified\n"
    text += "Camera1.fx: 580.0\nCamera1.fy: 580.0\nCamera1.cx: 320.0\nCamera1.cy: 256.0\n"
    (tmp_path / "s.yaml").write_text(text + "Camera.width: 640\nCamera.height: 512\nStereo.b: 0.0042\n")
    found = read_calibration(tmp_path / "s.yaml")
    assert check_pair(found, "s") == pytest.approx(4.2) and found.rectified
    (tmp_path / "s.yaml").write_text(text.replace("Camera1", "Camera") + "Camera.bf: 2.436\n")
    assert check_pair(read_calibration(tmp_path / "s.yaml"), "s") == pytest.approx(4.2)


def colmap(model, numbers):
    head = "# Camera list with one line of data per camera:\n#   CAMERA_ID, MODEL, WIDTH, HEIGHT, PARAMS[]\n"
    return f"{head}# Number of cameras: 1\n1 {model} 640 512 {numbers}\n"


SINGLE = {
    "3x3": ("intrinsics.txt", "580 0 318.2\n0 582 255.1\n0 0 1\n", [], 0.5),
    "3x4, commas": ("intrinsics.txt", "580,0,318.2,0\n0,582,255.1,0\n0,0,1,0\n", [], 0.5),
    "printed by NumPy": ("K.txt", "[[580.   0.  318.2]\n [  0.  582.  255.1]\n [  0.    0.    1. ]]", [], 0.5),
    "fx fy cx cy": ("intrinsics.txt", "# fx fy cx cy\n580 582 318.2 255.1\n", [], 0.5),
    "with distortion": ("calib.txt", "580 582 318.2 255.1 -0.1 0.02 0.001 -0.002\n", D1, 0.5),
    "COLMAP pinhole": ("cameras.txt", colmap("PINHOLE", "580 582 318.7 255.6"), [], 0),
    "COLMAP OpenCV": ("cameras.txt", colmap("OPENCV", "580 582 318.7 255.6 -0.1 0.02 0.001 -0.002"), [*D1, 0], 0),
    "COLMAP full": ("cameras.txt", colmap("FULL_OPENCV", "580 582 318.7 255.6 1 2 3 4 5 6 7 8"), range(1, 9), 0),
    "nerfstudio": (
        "transforms.json",
        json.dumps(
            dict(fl_x=580, fl_y=582, cx=318.7, cy=255.6, w=640, h=512, camera_model="OPENCV")
            | dict(k1=-0.1, k2=0.02, p1=0.001, p2=-0.002)
        ),
        [*D1, 0], 0,
    ),
    "ORB-SLAM": (
        "cam.yaml",
        "%YAML:1.0\nCamera.fx: 580.\nCamera.fy: 582.\nCamera.cx: 318.2\nCamera.cy: 255.1\n"
        "Camera.k1: -0.1\nCamera.k2: 0.02\nCamera.p1: 0.001\nCamera.p2: -0.002\n"
        "Camera.width: 640\nCamera.height: 512\n",
        [*D1, 0], 0.5,
    ),
    "three radial": ("c.json", json.dumps({"K": K1.tolist(), "D": [-0.1, 0.02, 0.03]}), [-0.1, 0.02, 0, 0, 0.03], 0.5),
    "MATLAB's names": (
        "c.json",
        json.dumps({"K": K1.tolist(), "RadialDistortion": [-0.1, 0.02, 0.03], "tangential": [0.001, -0.002]}),
        [*D1, 0.03], 0.5,
    ),
    "two radial": ("c.json", json.dumps({"K": K1.tolist(), "D": [-0.1, 0.02]}), [-0.1, 0.02, 0, 0], 0.5),
}  # fmt: skip


@pytest.mark.parametrize("form", SINGLE)
def test_single_cameras_of_other_programs(tmp_path, form):
    name, text, distortion, _ = SINGLE[form]
    (tmp_path / name).write_text(text)
    found = read_calibration(tmp_path / name)
    assert found.right is None and np.allclose(found.left.matrix, K1 + HALF)
    assert np.allclose(found.left.distortion, distortion)
    if form in ("COLMAP pinhole", "nerfstudio", "ORB-SLAM"):
        assert found.size == (640, 512)
    assert any("no lens distortion is stated" in note for note in found.notes) == (len(distortion) == 0)


@pytest.mark.parametrize("model", sorted({*MODELS} - {*UNSUPPORTED}))
def test_every_model_of_colmap(tmp_path, model):
    names = MODELS[model].split()
    numbers = {name: 580.0 + i if i < 2 and name[0] == "f" else 318.2 if name[0] == "c" else 0.01 * i
               for i, name in enumerate(names)}  # fmt: skip
    text = "# Camera list with one line of data per camera:\n" + colmap(model, " ".join(map(str, numbers.values())))
    (tmp_path / "cameras.txt").write_text(text)
    found, lens = read_calibration(tmp_path / "cameras.txt").left, Lens.of(model, 640, 512, numbers)
    assert np.allclose(found.matrix, lens.matrix) and found.fisheye == model.endswith("FISHEYE")
    assert np.allclose(np.pad(found.distortion, (0, len(lens.distortion) - len(found.distortion))), lens.distortion)


def test_colmap_binary(tmp_path):
    values = (580, 582, 318.7, 255.6, *D1)
    (tmp_path / "cameras.bin").write_bytes(struct.pack("<QiiQQ8d", 1, 1, 4, 640, 512, *values))
    found = read_calibration(tmp_path / "cameras.bin")
    assert np.allclose(found.left.matrix, K1 + HALF) and found.size == (640, 512)
    assert np.allclose(found.left.distortion, [*D1, 0]) and found.right is None


ROS_MATRIX = f"camera_matrix: {{rows: 3, cols: 3, data: {rows(K1.ravel())}}}\n"
ROS_DISTORTION = f"distortion_coefficients: {{rows: 1, cols: 4, data: {rows(D1)}}}\n"
FOUR_RADIAL = orb_slam3().replace("p1:", "k3:").replace("p2:", "k4:")
FISHEYES = {
    "ROS": ("c.yaml", f"{ROS_MATRIX}distortion_model: equidistant\n{ROS_DISTORTION}"),
    "a word": ("c.json", json.dumps({"model": "fisheye", "K": K1.tolist(), "D": D1.tolist()})),
    "a flag": ("c.json", json.dumps({"fisheye": True, "K": K1.tolist(), "D": D1.tolist()})),
    "OpenCV's sample": ("c.yaml", f"fisheye_model: 1\n{ROS_MATRIX}{ROS_DISTORTION}"),
    "Kalibr": ("c.yaml", kalibr().replace("radtan", "equidistant")),
    "ORB-SLAM3": ("c.yaml", FOUR_RADIAL.replace("PinHole", "KannalaBrandt8")),
    "COLMAP": ("cameras.txt", colmap("OPENCV_FISHEYE", "580 582 318.7 255.6 -0.1 0.02 0.001 -0.002")),
}


@pytest.mark.parametrize("form", FISHEYES)
def test_a_fisheye_is_told_by_its_name(tmp_path, form):
    name, text = FISHEYES[form]
    (tmp_path / name).write_text(text)
    found = read_calibration(tmp_path / name)
    assert found.left.fisheye and np.allclose(found.left.distortion, D1) and np.allclose(found.left.matrix, K1 + HALF)
    assert found.right is None or (found.right.fisheye and np.allclose(found.right.distortion, D2))


def test_a_fisheye_without_coefficients_is_bent(tmp_path):
    (tmp_path / "c.json").write_text(json.dumps({"model": "fisheye", "K": K1.tolist()}))
    assert read_calibration(tmp_path / "c.json").left.bent


def in_json(**items):
    return json.dumps({"K": K1.tolist()} | items)


REJECTED = {
    "omni": ("c.yaml", kalibr("omni"), "got omni"),
    "omni of Kalibr": ("c.yaml", kalibr("omni", [1.2]), "got omni"),
    "ds of Kalibr": ("c.yaml", kalibr("ds", [-0.2, 0.5]), "got ds"),
    "MEI": ("c.yaml", "%YAML:1.0\nmodel_type: MEI\nmirror_parameters:\n   xi: 1.2\n", "got MEI"),
    "omni of OpenCV's sample": ("c.json", in_json(D=[0.1] * 4, xi=1.2), "omnidirectional"),
    "fov": ("cameras.txt", colmap("FOV", "1 2 3 4 5"), "got FOV"),
    "an unknown model": ("c.json", in_json(distortion_model="division2", D=[0.1] * 4), "got division2"),
    "which of two models": ("c.json", in_json(k1=1, k2=1, k3=1, k4=1), "the model of the distortion"),
    "an unknown name": ("c.json", in_json(lens_dist=[0.1] * 4), "known name of the distortion, got lensdist"),
    "MATLAB": ("c.mat", b"MATLAB 5.0 MAT-file, Platform", "a .mat file of MATLAB"),
    "HDF5": ("c.mat", b"\x89HDF\r\n\x1a\n", "HDF5"),
    "pickle": ("c.pkl", b"\x80\x04\x95", "a pickle, which could run programs"),
    "COLMAP without a number": ("cameras.txt", colmap("SIMPLE_RADIAL", "nan 320 256 0"), "fx to be a number, got nan"),
    "COLMAP with a word": ("cameras.txt", colmap("SIMPLE_RADIAL", "f 320 256 0"), "rows `CAMERA_ID MODEL WIDTH"),
    "COLMAP cut": ("cameras.bin", b"\x01" + bytes(30), "a .bin file that ends too early"),
    "Metashape": ("c.xml", "<?xml version='1.0'?><calibration><f>1</f></calibration>", "got <calibration>"),
    "entities": ("c.xml", "<!DOCTYPE x [<!ENTITY a 'b'>]><opencv_storage/>", "a document type"),
    "two of COLMAP": ("cameras.txt", colmap("PINHOLE", "1 2 3 4") + "2 PINHOLE 640 512 1 2 3 4\n", "2 cameras"),
    "projection": ("P.txt", "580 0 318 -9\n0 582 255 0\n0 0 1 0\n", "a projection matrix"),
    "skew": ("c.json", json.dumps({"K": [[500, 9, 320], [0, 500, 256], [0, 0, 1]]}), "without skew"),
    "transposed": ("c.json", json.dumps({"K": K1.T.tolist()}), "a camera matrix"),
    "five of a fisheye": ("c.json", in_json(model="fisheye", D=[0.1] * 5), "4 coefficients"),
    "numbers": ("c.txt", "1 2 3\n4 5 6\n", "a 3x3 camera matrix"),
}  # fmt: skip


@pytest.mark.parametrize("kind", REJECTED)
def test_what_is_not_read_is_named(tmp_path, kind):
    name, content, says = REJECTED[kind]
    (tmp_path / name).write_bytes(content if isinstance(content, bytes) else content.encode())
    with pytest.raises(InputError) as error:
        read_calibration(tmp_path / name)
    assert says in str(error.value) and "Fix: " in str(error.value) and "\n" not in str(error.value)


@pytest.mark.parametrize(
    ("encoding", "mark"),
    [
        ("utf-8", codecs.BOM_UTF8), ("utf-16-le", codecs.BOM_UTF16_LE), ("utf-16-be", codecs.BOM_UTF16_BE),
        ("utf-16-le", b""), ("latin-1", b""),
    ],
)  # fmt: skip
@pytest.mark.parametrize("form", ["Kalibr", "da Vinci", "OpenCV XML", "OpenCV JSON"])
def test_encodings_of_windows(tmp_path, form, encoding, mark):
    name, text = PAIRS[form]
    comment = "" if form.startswith("OpenCV") else "# Gerät 1, Prüfung\r\n"
    (tmp_path / name).write_bytes(mark + (comment + text().replace("\n", "\r\n")).encode(encoding))
    assert np.allclose(read_calibration(tmp_path / name).right.matrix, K2 + HALF)


def test_an_array_is_read_and_a_pickled_one_is_not(tmp_path):
    np.save(tmp_path / "intrinsics.npy", K1)
    assert np.allclose(read_calibration(tmp_path / "intrinsics.npy").left.matrix, K1 + HALF)
    np.save(tmp_path / "c.npy", np.array([{}]), allow_pickle=True)
    with pytest.raises(InputError, match="a readable calibration"):
        read_calibration(tmp_path / "c.npy")
